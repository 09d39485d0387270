"""The training loop: draw, forward, backward, step; validate, keep the best, and go on exactly where a run stopped."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.data.database import ObjectDatabase
from beambox.data.mixture import MixedSource
from beambox.train.config import Recipe
from beambox.train.dataset import TrainingDataset
from beambox.train.devices import make_fabric
from beambox.train.folder import BEST, FINAL, LAST, OBJECTS, locked
from beambox.train.log import RunLog
from beambox.train.preflight import check_labels, check_recipe
from beambox.train.run import ModelWithLoss, Run
from beambox.train.sources import Augment, open_database, open_source
from beambox.train.start import build_detector
from beambox.train.validate import Validator

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["ModelWithLoss", "Run", "TrainResult", "train"]


@dataclass(frozen=True)
class TrainResult:
    """How a run ended."""

    step: int
    """Optimiser steps made."""
    finished: bool
    """False where it was interrupted."""
    weights: Path | None
    """The weights to use: the best by validation, else the last; None where interrupted before any were written."""
    score: float | None
    """Validation score of the best weights, percent."""


def train(
    recipe: Recipe, data: Path | None, out: Path, resume: bool = False, shared_objects: Path | None = None
) -> TrainResult:
    """Train a detector.

    Args:
        recipe: what to do.
        data: folder that ``{data}`` stands for in the recipe.
        out: folder of the run; gets ``last.safetensors`` (to go on from), ``best.safetensors`` and
            ``final.safetensors`` (weights to use), ``log.jsonl`` and ``tensorboard/``.
        resume: go on from ``last.safetensors`` instead of starting afresh.
        shared_objects: object database to use, and to cut first where it is not there; by default the run's own.

    Raises:
        BeamboxError: for anything in the recipe, the data or the folder that cannot be used.
    """
    if (out / LAST).exists() and not resume:
        raise BeamboxError(f"{out} holds a run already; go on with it by --resume, or give another --out")
    if recipe.threads:
        torch.set_num_threads(recipe.threads)
    fabric = make_fabric(recipe.precision)
    with locked(out) if fabric.global_rank == 0 else nullcontext():
        return _train(recipe, data, out, fabric, resume, shared_objects)


def _train(
    recipe: Recipe, data: Path | None, out: Path, fabric: Fabric, resume: bool, shared_objects: Path | None
) -> TrainResult:
    reuse = resume or shared_objects is not None
    run = build_run(recipe, data, out, fabric, shared_objects or out / OBJECTS, reuse)
    changed = run.restore() if resume else []
    log = RunLog(out, run.total, run.step, active=fabric.global_rank == 0)
    try:
        log_header(run, log)
        if resume:
            log.info(f"going on after step {run.step}")
        if changed:
            log.info(f"note: the recipe has changed since, so the run is not the one it would have been: {changed}")
        finished = run.loop(log)
        run.save()
        if finished:
            with run.measured():
                run.validate(log)
                final = run.export(FINAL, {})
            run.save()
            best = out / BEST
            log.info(f"finished; weights: {best if run.best is not None else final}")
            return TrainResult(run.step, True, best if run.best is not None else final, run.best)
        log.info(f"interrupted after step {run.step} of {run.total}; the same command with --resume goes on from there")
        return TrainResult(run.step, False, out / BEST if run.best is not None else None, run.best)
    finally:
        log.close()


def build_run(recipe: Recipe, data: Path | None, out: Path, fabric: Fabric, objects: Path, reuse: bool) -> Run:
    """Build the detector, the stream of batches and the validation that a recipe asks for.

    Args:
        recipe: what to do.
        data: folder that ``{data}`` stands for.
        out: folder of the run.
        fabric: devices and processes.
        objects: file of the object database, where the recipe samples objects.
        reuse: take that file if it is there already.
    """
    detector, notes = build_detector(recipe.detector, recipe.seed)
    config = detector.config
    check_recipe(recipe, config, fabric.world_size)
    sources = [open_source(section, data) for section in recipe.data]
    joined = MixedSource(sources, tuple(s.weight for s in recipe.data if s.weight is not None) or None)
    check_labels(joined, "training data", config.classes, config.grid, notes.append, config.num_point_features)
    validation = open_source(recipe.validation.source, data) if recipe.validation else None
    if validation is not None:
        check_labels(
            validation, "validation data", config.classes, config.grid, notes.append, config.num_point_features
        )
    database = None
    if recipe.augment and recipe.augment.sample:
        if fabric.global_rank == 0:
            open_database(recipe, data, objects, reuse, lambda text: print(text, flush=True))
        fabric.barrier()
        database = ObjectDatabase.load(objects)
    dataset = TrainingDataset(
        joined,
        Augment(recipe.augment, database, recipe.seed),
        config.classes,
        config.grid,
        recipe.optim.batch,
        recipe.window,
        seed=recipe.seed,
        rank=fabric.global_rank,
        world=fabric.world_size,
    )
    run = Run(recipe, detector, dataset, fabric, out)
    run.notes += notes
    if recipe.validation and validation is not None:
        run.validator = Validator(recipe.validation, validation, run.dtype)
    return run


def log_header(run: Run, log: RunLog) -> None:
    """Say what is about to happen."""
    recipe, fabric = run.recipe, run.fabric
    count = sum(parameter.numel() for parameter in run.detector.parameters())
    log.info(f"beambox {__version__}: {recipe.name}, seed {recipe.seed}, {count / 1e6:.2f} M parameters")
    precision = str(run.dtype).removeprefix("torch.")
    log.info(
        f"{fabric.world_size} x {fabric.device.type}, {precision}, {torch.get_num_threads()} threads; "
        f"{len(run.dataset.source)} frames per epoch, {run.per_epoch:.0f} steps per epoch, {run.total} steps"
    )
    for note in run.notes:
        log.info(note)
