"""Recipes of several stages: each changes some values of the recipe and begins with the weights of the one before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from beambox.checks import BeamboxError
from beambox.train.config import Recipe, apply_overrides, load_recipe, parse_recipe
from beambox.train.loop import FINAL, LAST, TrainResult, train

__all__ = ["read_stages", "train_stages"]


def read_stages(path: str | Path, overrides: Sequence[str] = ()) -> list[Recipe]:
    """Read a recipe as the list of its stages; one without ``stages`` is a list of one.

    Args:
        path: the name of a shipped recipe, or a file.
        overrides: changes as ``a.b=value``, made in every stage; ``stages.NAME.a.b=value`` changes one of them.

    Raises:
        BeamboxError: for whatever :func:`~beambox.train.config.read_recipe` refuses, naming the stage.
    """
    values = load_recipe(path)
    if "stages" not in values:
        return [parse_recipe(apply_overrides(values, overrides), where=str(path))]
    stages = values["stages"]
    if not isinstance(stages, Mapping) or not all(isinstance(stage, Mapping) for stage in stages.values()):
        raise BeamboxError(f"{path}: `stages` must map each stage's name to what it changes, got {stages!r}")
    own = [text for text in overrides if text.startswith("stages.")]
    for text in own:
        if text.split(".")[1] not in stages:
            raise BeamboxError(f"`--set {text}`: there is no such stage; the stages are {', '.join(stages)}")
    stages = apply_overrides({"stages": stages}, own)["stages"] if own else stages
    everywhere = [text for text in overrides if text not in own]
    base = {key: value for key, value in values.items() if key != "stages"}
    return [
        parse_recipe(apply_overrides(_merged(base, changes), everywhere), where=f"{path}, stage {name}")
        for name, changes in stages.items()
    ]


def train_stages(recipes: Sequence[Recipe], data: Path | None, out: Path, resume: bool = False) -> TrainResult:
    """Train the stages one after the other.

    Args:
        recipes: what :func:`read_stages` returns.
        data: folder that ``{data}`` stands for.
        out: folder of the last stage, whose weights are the result; the others lie in ``out/stage1``, ...
        resume: go on where the last call stopped.

    Raises:
        BeamboxError: for anything that :func:`~beambox.train.loop.train` refuses.
    """
    folders = [out / f"stage{number}" for number in range(1, len(recipes))] + [out]
    started = [folder for folder in folders if (folder / LAST).exists()]
    if started and not resume:
        raise BeamboxError(f"{started[0]} holds a run already; go on with it by --resume, or give another --out")
    outcome = None
    for number, (recipe, folder) in enumerate(zip(recipes, folders)):
        if resume and folder != out and (folder / FINAL).exists():
            continue
        begun = _starting_from(recipe, folders[number - 1] / FINAL) if number else recipe
        outcome = train(begun, data, folder, resume and (folder / LAST).exists())
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.barrier()  # the next stage reads what the first process has written
        if not outcome.finished:
            break
    assert outcome is not None, "the last stage always runs"
    return outcome


def _starting_from(recipe: Recipe, weights: Path) -> Recipe:
    """Return the recipe with these weights to begin with, where it names none."""
    if recipe.detector.start_from is not None:
        return recipe
    detector = recipe.detector.model_copy(update={"start_from": str(weights)})
    return recipe.model_copy(update={"detector": detector})


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with values of ``changes`` in place of its own, sections merged, lists replaced."""
    merged = dict(base)
    for key, value in changes.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merged(merged[key], value) if both else value
    return merged
