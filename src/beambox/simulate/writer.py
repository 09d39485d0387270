"""Writes simulated data sets in KITTI's or ONCE's layout: whole files only, continued where they stopped."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beambox import __version__
from beambox.checks import BeamboxError, did_you_mean
from beambox.data.kitti import write_kitti_frame, write_split
from beambox.io import read_json, write_text
from beambox.simulate.frames import VIEWS, simulate_frame
from beambox.simulate.layouts import check_layout
from beambox.simulate.once_files import OnceFiles
from beambox.simulate.sensors import Sensor, load_sensor

__all__ = ["write_dataset"]

FILES = ("kitti", "once")
_CARD = "simulation.json"
_VAL_SALT = 77


def write_dataset(
    out: Path | str,
    frames: int,
    sensor: str | Path | Sensor | None = None,
    view: str | None = None,
    layout: str = "random",
    seed: int = 0,
    workers: int = 1,
    val_share: float = 0.1,
    layout_split: str | None = "train",
    progress: Callable[[int, int], None] | None = None,
    *,
    files: str = "kitti",
    sequence_length: int = 10,
) -> Path:
    """Write ``frames`` frames to ``out`` in KITTI's or ONCE's layout; frames already there are kept.

    A frame depends on (seed, index) alone, so the number of workers changes nothing. ``simulation.json`` records what
    the folder was made with; asking for more frames of the same goes on where it stopped.

    Args:
        out: folder that gets training/{velodyne,calib,label_2} and ImageSets/{train,val}.txt, or with ONCE's layout
            data/SEQUENCE/{SEQUENCE.json,lidar_roof} and ImageSets/{train,val}.txt.
        frames: how many.
        sensor: preset, YAML file or sensor; None takes hdl64 for KITTI's layout, pandar40 for ONCE's.
        view: ``camera`` or ``full``; None takes camera for KITTI's layout, full for ONCE's, which has no other.
        layout: ``random``, ``kitti:PATH`` or ``mixed:PATH``.
        seed: of the data set.
        workers: processes; 1 works in this one.
        val_share: share of the frames that go to val.txt, of the sequences with ONCE's layout.
        layout_split: list of the layouts to draw from; None draws from all.
        progress: called with (frames done, frames) after each frame, with ONCE's layout after each sequence.
        files: ``kitti`` or ``once``, the layout of the files and the classes.
        sequence_length: frames in one sequence, only in ONCE's layout.

    Returns:
        The folder.

    Raises:
        BeamboxError: bad arguments, or ``out`` holds another simulation or other data.
    """
    if files not in FILES:
        raise BeamboxError(f"`files` must be kitti or once, got {files!r}{did_you_mean(files, FILES)}")
    once = files == "once"
    out, sensor = Path(out), load_sensor(sensor or ("pandar40" if once else "hdl64"))
    view = view or ("full" if once else "camera")
    if frames < 1 or workers < 1:
        raise BeamboxError(f"`frames` and `workers` must be at least 1, got {frames} and {workers}")
    if sequence_length < 1:
        raise BeamboxError(f"`sequence_length` must be at least 1, got {sequence_length}")
    if not 0 <= val_share < 1:
        raise BeamboxError(f"`val_share` must be at least 0 and less than 1, got {val_share}")
    if view not in VIEWS:
        raise BeamboxError(f"`view` must be camera or full, got {view!r}")
    if once and view != "full":
        raise BeamboxError("ONCE labels the whole turn; leave out `view`, or give full")
    check_layout(layout)
    options = {"sensor": sensor, "view": view, "layout": layout, "layout_split": layout_split}
    card = {"files": files, "seed": seed, "val_share": val_share, "sequence_length": sequence_length if once else None}
    _reserve(out, {**card, **options, "sensor": json.loads(json.dumps(asdict(sensor)))})
    layer = (
        OnceFiles(str(out), seed, options, val_share, sequence_length)
        if once
        else KittiFiles(str(out), seed, options, val_share)
    )
    tasks = layer.missing(frames)
    done = frames - sum(len(task) for task in tasks)
    try:
        for count in _work(layer.write, tasks, workers):
            done += count
            if progress is not None:
                progress(done, frames)
    finally:
        layer.write_splits()
    return out


@dataclass(frozen=True)
class KittiFiles:
    """KITTI's layout: a task is one frame."""

    out: str
    """Folder."""
    seed: int
    """Of the data set."""
    options: dict[str, Any]
    """Further arguments of :func:`simulate_frame`."""
    val_share: float
    """Share of the frames for validation."""

    @property
    def _labels(self) -> Path:
        return Path(self.out) / "training" / "label_2"

    def missing(self, frames: int) -> list[range]:
        """Numbers of the frames that are not there yet, one a task."""
        return [range(i, i + 1) for i in range(frames) if not (self._labels / f"{i:06d}.txt").exists()]

    def write(self, task: range) -> int:
        """Simulate and write one frame; the label file comes last and marks it as whole."""
        write_kitti_frame(self.out, simulate_frame(self.seed, task[0], **self.options))
        return len(task)

    def write_splits(self) -> None:
        """List the frames that are whole; of them the exact share is for validation, drawn by the seed."""
        names = sorted(p.stem for p in self._labels.glob("*.txt"))
        drawn = sorted(names, key=lambda n: np.random.default_rng([self.seed, int(n), _VAL_SALT]).random())
        val = set(drawn[: round(self.val_share * len(names))])
        write_split(self.out, "train", [n for n in names if n not in val])
        write_split(self.out, "val", [n for n in names if n in val])


def _reserve(out: Path, card: dict) -> None:
    """Record what the folder is made with, or refuse where it holds something else."""
    path = out / _CARD
    if path.exists():
        try:
            before = read_json(path)
        except BeamboxError as error:
            raise BeamboxError(f"{error}; delete the folder or give another") from None
        before = {"files": "kitti", **before}  # cards of old name no layout
        for key, value in card.items():
            if before.get(key) != value:
                what, then, now = _difference(key, before.get(key), value)
                raise BeamboxError(
                    f"{out} was simulated with {what} {then!r}, now {now!r} is asked for; "
                    "give the same options to go on, or another folder"
                )
        return
    if any((out / name).exists() for name in ("training", "data", "ImageSets")):
        raise BeamboxError(f"{out} holds other data (no {_CARD}); give another folder")
    write_text(path, json.dumps({**card, "beambox": __version__}, indent=1) + "\n")


def _difference(key: str, then: Any, now: Any) -> tuple[str, Any, Any]:
    """Name what differs in an entry of the card; of two sensors the name, or the first value that differs."""
    if key != "sensor" or not isinstance(then, dict) or not isinstance(now, dict):
        return key, then, now
    field = next(field for field in now if then.get(field) != now[field])
    return ("sensor", then[field], now[field]) if field == "name" else (f"sensor.{field}", then.get(field), now[field])


def _work(write: Callable[[range], int], tasks: list[range], workers: int) -> Iterator[int]:
    """Yield how many frames each task wrote, once it has."""
    if workers == 1 or len(tasks) < 2:
        yield from map(write, tasks)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(tasks)), mp_context=context) as pool:
        waiting: set[Future[int]] = set()
        try:
            for task in tasks:
                waiting.add(pool.submit(write, task))
                if len(waiting) >= 4 * workers:
                    finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                    yield from (f.result() for f in finished)
            while waiting:
                finished, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (f.result() for f in finished)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
