"""Tables of the papers, trained again: one recipe, one list of seeds, and only a row's switches between two rows."""

from __future__ import annotations

import hashlib
import json
import os
import re
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError
from beambox.data.source import FrameSource
from beambox.detectors.contract import AnyModel, module_of
from beambox.detectors.weights import load_weights
from beambox.infer.evaluate import Detect, detect_frames, network, scored_frames
from beambox.io import read_json, write_json
from beambox.structures import Detections, Frame
from beambox.train.config import Recipe, parse_recipe
from beambox.train.loop import FINAL, LAST, train
from beambox.train.sources import open_source, shared_database
from beambox.train.tables import Table
from beambox.train.validate import score_by

__all__ = ["Interrupted", "Measured", "report", "run_table", "to_json"]

WARM_UP = 3
"""Sweeps that are detected before time counts."""

Measured = dict[str, list[list[float | None]]]
"""Of each trained row, by name, for every seed the number of each column; None where nothing could be scored."""


class Interrupted(Exception):
    """Training was stopped by a signal; the same call goes on."""


def run_table(
    table: Table,
    recipe: Recipe,
    data: Path | None,
    out: Path,
    seeds: Sequence[int],
    log: Callable[[str], None] = print,
) -> Measured:
    """Train and score every row of a table for every seed.

    Each run has a folder of its own under ``out``, named by its switches and seed; what is there already is not
    repeated, and rows that two tables share are trained once. Objects for sampling are cut out of the data once for all
    runs that sample the same ones, into ``out``. The weights after the last step are scored, on the
    recipe's validation source: nothing is chosen by the numbers that are printed.

    Args:
        table: what to do.
        recipe: of every row; its own validation during training is left out.
        data: folder that ``{data}`` stands for in the recipe.
        out: folder of the runs.
        seeds: one run each.
        log: told before each run.

    Raises:
        BeamboxError: if the recipe lacks a validation source, or a folder holds runs of another recipe.
        Interrupted: after a signal.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise BeamboxError("ablate runs in one process; start it without torchrun, or train single rows with `train`")
    if recipe.validation is None:
        raise BeamboxError(f"recipe {recipe.name} has no `validation`, whose source a table is scored on")
    if not seeds:
        raise BeamboxError("a table needs at least one seed")
    source = open_source(recipe.validation.source, data)
    trained = [(row, dict(row.options)) for row in table.rows if row.options is not None]
    plans = [(row, seed, row_recipe(recipe, options, seed)) for row, options in trained for seed in seeds]
    measured: Measured = {row.name: [] for row, _ in trained}
    for number, (row, seed, plan) in enumerate(plans, 1):
        folder = out / recipe.name / folder_name(row.options or {}) / f"seed-{seed}"
        log(f"row {row.name}, seed {seed} ({number} of {len(plans)}): {folder}")
        scores = run_row(plan, recipe, source, data, folder, out)
        measured[row.name].append([value_at(scores, column.path) for column in table.columns])
    return measured


def row_recipe(recipe: Recipe, options: Mapping[str, Any], seed: int) -> Recipe:
    """Return the recipe of one run: with the row's switches, without validation on the way."""
    plain = recipe.model_dump(mode="python")
    plain["detector"]["options"] = merged(plain["detector"]["options"], options)
    return parse_recipe({**plain, "seed": seed, "validation": None}, where=f"recipe {recipe.name}")


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with ``changes`` laid over it, mappings inside mappings likewise."""
    joined = dict(base)
    for key, value in changes.items():
        under = joined.get(key)
        joined[key] = merged(under, value) if isinstance(under, Mapping) and isinstance(value, Mapping) else value
    return joined


def folder_name(options: Mapping[str, Any]) -> str:
    """Name a folder by switches: readable, and distinct for distinct switches."""
    if not options:
        return "as-recipe"
    details = "_".join(f"{key}={json.dumps(value)}" for key, value in sorted(options.items()))
    exact = hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()[:6]
    return re.sub(r"[^A-Za-z0-9=_.]+", "-", details.replace('"', ""))[:60].strip("-") + "_" + exact


def run_row(
    plan: Recipe, recipe: Recipe, source: FrameSource, data: Path | None, folder: Path, out: Path
) -> dict[str, Any]:
    """Train one run, or go on with it, and score its last weights; returns the scores."""
    identity = plan.model_dump(mode="json", exclude={"workers", "threads", "log_every", "save_every", "description"})
    reserve(folder, identity)
    scored = folder / "scores.json"
    if scored.is_file():
        return read_json(scored)
    if not (folder / FINAL).is_file():
        objects = shared_database(plan, data, out)
        if not train(plan, data, folder, resume=(folder / LAST).exists(), shared_objects=objects).finished:
            raise Interrupted
    assert recipe.validation is not None
    scores = score(load_weights(folder / FINAL), source, recipe)
    write_json(scored, scores)
    return scores


def reserve(folder: Path, identity: dict[str, Any]) -> None:
    """Mark a folder as that of a run.

    Raises:
        BeamboxError: if it belongs to another one.
    """
    path = folder / "recipe.json"
    if path.is_file():
        stored = read_json(path)
        differing = sorted(key for key in {*stored, *identity} if stored.get(key) != identity.get(key))
        if differing:
            raise BeamboxError(
                f"{folder} holds a run of another recipe (its `{differing[0]}` differs); "
                "remove it or give another --out"
            )
        return
    write_json(path, identity)


def score(model: AnyModel, source: FrameSource, recipe: Recipe) -> dict[str, Any]:
    """Score a detector by the rules of its data, ONCE's for ONCE, else KITTI's; with the time that it took."""
    import torch

    assert recipe.validation is not None
    module_of(model).to("cuda" if torch.cuda.is_available() else "cpu")
    timed = Timed(network(model))
    frames = scored_frames(detect_frames(timed, source))
    result = score_by(recipe.validation, frames, model.config.classes)
    return {**result.to_json(), "time": {"ms": timed.median()}}


class Timed:
    """Detects, and keeps the milliseconds of each call; detections arrive on the CPU, so the device is done by then."""

    def __init__(self, detect: Detect) -> None:
        self.detect = detect
        self.milliseconds: list[float] = []

    def __call__(self, frames: Sequence[Frame]) -> list[Detections]:
        """Detect in some frames."""
        start = time.perf_counter()
        found = self.detect(frames)
        self.milliseconds.append(1000 * (time.perf_counter() - start))
        return found

    def median(self) -> float | None:
        """Return the median of all calls but the first few, which warm up; None where there is no call left."""
        steady = self.milliseconds[WARM_UP:]
        return statistics.median(steady) if steady else None


def value_at(scores: Any, path: Sequence[str | int]) -> float | None:
    """Follow a column's path into scores; None where they lack it (a class without objects, no camera)."""
    for key in path:
        try:
            scores = scores[key]
        except (KeyError, IndexError):
            return None
    return scores


def report(table: Table, measured: Measured, ours: str = "") -> str:
    """Return the table as text: of each row a line of the paper's numbers and one of ours, never mixed.

    Args:
        table: the paper's.
        measured: from :func:`run_table`; empty prints the paper alone.
        ours: what our numbers were measured on.
    """
    wide = max(len(row.name) for row in table.rows)
    groups = [(name, len(list(run))) for name, run in groupby(column.group for column in table.columns)]
    cell = max(10, *(len(column.name) + 2 for column in table.columns), *(-(-len(g) // n) + 2 for g, n in groups))

    def line(name: str, kind: str, cells: Iterable[float | None]) -> str:
        return f"{name:<{wide}}  {kind:>5}" + "".join(
            f"{'-' if value is None else format(value, '.2f'):>{cell}}" for value in cells
        )

    lines = [table.title, f"paper: {table.protocol}", *table.remarks]
    if measured:
        lines += [f"ours:  {ours}"]
        lines += ["       compare differences between rows: data and length of training may not be the paper's"]
    lines += ["", " " * (wide + 7) + "".join(f"{name:>{cell * count}}" for name, count in groups)]
    lines += [" " * (wide + 7) + "".join(f"{column.name:>{cell}}" for column in table.columns)]
    for row in table.rows:
        lines.append(line(row.name, "paper", row.published))
        runs = measured.get(row.name, [])
        if runs:
            lines.append(line("", "ours", map(mean, zip(*runs))))
        if len(runs) > 1:
            lines.append(line("", "+-", map(spread, zip(*runs))))
    return "\n".join(lines) + "\n"


def mean(values: Sequence[float | None]) -> float | None:
    """Mean over the seeds; None where any has no number."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if len(known) == len(values) and known else None


def spread(values: Sequence[float | None]) -> float | None:
    """Sample standard deviation over the seeds."""
    known = [value for value in values if value is not None]
    return statistics.stdev(known) if len(known) == len(values) and len(known) > 1 else None


def to_json(table: Table, measured: Measured, recipe: Recipe, seeds: Sequence[int]) -> dict[str, Any]:
    """Return paper and ours, apart, ready for ``json.dump``."""
    return {
        "title": table.title,
        "protocol": table.protocol,
        "recipe": recipe.model_dump(mode="json"),
        "seeds": list(seeds),
        "columns": [f"{column.group} {column.name}" for column in table.columns],
        "rows": [
            {
                "name": row.name,
                "options": None if row.options is None else dict(row.options),
                "paper": list(row.published),
                "ours": measured.get(row.name, []),
            }
            for row in table.rows
        ],
    }
