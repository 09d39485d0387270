"""Writes simulated data sets in KITTI's layout: whole files only, continued where they stopped."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict
from pathlib import Path

import numpy as np

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.data.files import read_text, write_text
from beambox.data.kitti import write_kitti_frame, write_split
from beambox.simulate.frames import VIEWS, simulate_frame
from beambox.simulate.layouts import check_layout
from beambox.simulate.sensors import Sensor, load_sensor

__all__ = ["write_dataset"]

_CARD = "simulation.json"
_VAL_SALT = 77


def write_dataset(
    out: Path | str,
    frames: int,
    sensor: str | Path | Sensor = "hdl64",
    view: str = "camera",
    layout: str = "random",
    seed: int = 0,
    workers: int = 1,
    val_share: float = 0.1,
    layout_split: str | None = "train",
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write ``frames`` frames to ``out`` in KITTI's layout; frames already there are kept.

    A frame depends on (seed, index) alone, so the number of workers changes nothing. ``simulation.json`` records what
    the folder was made with; asking for more frames of the same goes on where it stopped.

    Args:
        out: folder that gets training/{velodyne,calib,label_2} and ImageSets/{train,val}.txt.
        frames: how many.
        sensor: preset, YAML file or sensor.
        view: ``camera`` or ``full``.
        layout: ``random``, ``kitti:PATH`` or ``mixed:PATH``.
        seed: of the data set.
        workers: processes; 1 works in this one.
        val_share: share of the frames that go to val.txt.
        layout_split: list of the layouts to draw from; None draws from all.
        progress: called with (frames done, frames) after each frame.

    Returns:
        The folder.

    Raises:
        BeamboxError: bad arguments, or ``out`` holds another simulation or other data.
    """
    out, sensor = Path(out), load_sensor(sensor)
    if frames < 1 or workers < 1:
        raise BeamboxError(f"`frames` and `workers` must be at least 1, got {frames} and {workers}")
    if not 0 <= val_share < 1:
        raise BeamboxError(f"`val_share` must be at least 0 and less than 1, got {val_share}")
    if view not in VIEWS:
        raise BeamboxError(f"`view` must be camera or full, got {view!r}")
    check_layout(layout)
    card = {"seed": seed, "view": view, "layout": layout, "layout_split": layout_split, "val_share": val_share,
            "sensor": json.loads(json.dumps(asdict(sensor)))}  # fmt: skip
    _claim(out, card)
    options = {"sensor": sensor, "view": view, "layout": layout, "layout_split": layout_split}
    missing = [i for i in range(frames) if not _label_path(out, i).exists()]
    done = frames - len(missing)
    try:
        for _ in _work(out, seed, missing, options, workers):
            done += 1
            if progress is not None:
                progress(done, frames)
    finally:
        _write_splits(out, seed, val_share)
    return out


def _label_path(out: Path, index: int) -> Path:
    return out / "training" / "label_2" / f"{index:06d}.txt"


def _claim(out: Path, card: dict) -> None:
    """Record what the folder is made with, or refuse where it holds something else."""
    path = out / _CARD
    if path.exists():
        try:
            before = json.loads(read_text(path))
        except json.JSONDecodeError as error:
            raise BeamboxError(f"{path} is not JSON ({error}); delete the folder or give another") from None
        changed = [key for key, value in card.items() if before.get(key) != value]
        if changed:
            raise BeamboxError(
                f"{out} was simulated with {changed[0]} {before.get(changed[0])!r}, now {card[changed[0]]!r} is asked "
                "for; give the same options to go on, or another folder"
            )
        return
    if (out / "training").exists() or (out / "ImageSets").exists():
        raise BeamboxError(f"{out} holds other data (no {_CARD}); give another folder")
    write_text(path, json.dumps({**card, "beambox": __version__}, indent=1) + "\n")


def _one(out: str, seed: int, index: int, options: dict) -> int:
    """Simulate and write one frame; the label file comes last and marks it as whole."""
    write_kitti_frame(out, simulate_frame(seed, index, **options))
    return index


def _work(out: Path, seed: int, indices: list[int], options: dict, workers: int) -> Iterator[int]:
    """Yield each index once its frame is written."""
    if workers == 1 or len(indices) < 2:
        for index in indices:
            yield _one(str(out), seed, index, options)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(indices)), mp_context=context) as pool:
        waiting: set[Future[int]] = set()
        rest = iter(indices)
        try:
            for index in rest:
                waiting.add(pool.submit(_one, str(out), seed, index, options))
                if len(waiting) >= 4 * workers:
                    finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    yield from (f.result() for f in finished)
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (f.result() for f in finished)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _write_splits(out: Path, seed: int, val_share: float) -> None:
    """List the frames that are whole; which of them are for validation depends on (seed, index) alone."""
    names = sorted(p.stem for p in (out / "training" / "label_2").glob("*.txt"))
    val = {n for n in names if np.random.default_rng([seed, int(n), _VAL_SALT]).random() < val_share}
    write_split(out, "train", [n for n in names if n not in val])
    write_split(out, "val", [n for n in names if n in val])
