"""The detections of a drive in order, with a time and a pose for each sweep."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.geometry import Calibration
from beambox.infer.results import FORMATS, read_result
from beambox.structures import Detections, Frame
from beambox.track.poses import Floats, Poses
from beambox.track.tracker import Tracker
from beambox.track.tracks import Tracks

__all__ = ["Step", "frame_numbers", "read_drive", "stamps_of", "track_drive"]

LONGEST_GAP = 100_000
"""Numbers that may lie between two result files before they are taken for something else than a count of frames."""


@dataclass(frozen=True)
class Step:
    """One sweep of a drive."""

    name: str
    number: int
    """Of the frame in the drive: its name where names are numbers, otherwise its position."""
    detections: Detections


def read_drive(folder: Path, calibration: Callable[[str], Calibration] | Calibration | None = None) -> list[Step]:
    """Read result files of one drive, ours or KITTI text of any project, in order of their names.

    Where all names are numbers, a number without a file is a frame without detections.

    Args:
        folder: of .json, .csv or .txt files, one per sweep.
        calibration: for KITTI text: of the drive, or of a sweep by its name.

    Raises:
        MissingFileError: if there is no such folder or it holds no results.
        BeamboxError: naming the file that cannot be read.
    """
    if not folder.is_dir():
        raise MissingFileError(f"{folder}, the folder of result files, is not there")
    endings = sorted({path.suffix for path in folder.iterdir() if path.suffix in FORMATS.values()})
    if not endings:
        raise MissingFileError(f"{folder} holds no result file (*.json, *.csv or *.txt)")
    ending = endings[0] if ".json" not in endings else ".json"
    paths = sorted(folder.glob(f"*{ending}"))
    numbers = frame_numbers([path.stem for path in paths])
    paths = [path for _, path in sorted(zip(numbers, paths))]
    steps: list[Step] = []
    for number, path in zip(sorted(numbers), paths):
        while steps and steps[-1].number + 1 < number:
            steps.append(_empty(steps[-1].number + 1, path.stem))
        given = calibration(path.stem) if callable(calibration) else calibration
        frame = Frame(torch.zeros(0, 4), path.stem, calibration=given)
        steps.append(Step(path.stem, number, read_result(path, frame)))
    return steps


def _empty(number: int, like: str) -> Step:
    name = str(number).zfill(len(like))
    return Step(name, number, Detections.empty(frame_id=name))


def frame_numbers(names: Sequence[str]) -> list[int]:
    """Return the number of each frame in its drive: its name where all names are numbers, otherwise its position."""
    if all(name.isdecimal() and len(name) < 10 for name in names):
        numbers = [int(name) for name in names]
        if len(set(numbers)) == len(numbers) and max(numbers, default=0) - min(numbers, default=0) <= LONGEST_GAP:
            return numbers
    return list(range(len(names)))


def stamps_of(names: Sequence[str]) -> list[float] | None:
    """Return seconds since the first sweep where names are nanoseconds (as of recordings), or None."""
    last = [name.rsplit("/", maxsplit=1)[-1].split("-")[0] for name in names]
    if not all(word.isdecimal() and 15 <= len(word) <= 19 for word in last):
        return None
    first = int(last[0]) if last else 0
    return [(int(word) - first) / 1e9 for word in last]


def track_drive(
    tracker: Tracker,
    steps: Iterable[Step],
    *,
    poses: Poses | Callable[[], Floats] | None = None,
    times: Sequence[float] | None = None,
) -> Iterator[tuple[Step, Tracks]]:
    """Track through a drive.

    Args:
        tracker: new, or as it was left.
        steps: in order of time.
        poses: one for each frame number from that of the first step; or a function that gives that of the step at hand.
        times: seconds, one for each step; else those of the poses; else from the tracker's rate and frame numbers.

    Raises:
        BeamboxError: if there are fewer poses or times than frames.
    """
    first: int | None = None
    for k, step in enumerate(steps):
        first = step.number if first is None else first
        place = step.number if isinstance(poses, Poses) and step.number < len(poses) else step.number - first
        time = (step.number - first) / tracker.rate
        pose = None
        if isinstance(poses, Poses):
            if place >= len(poses):
                raise BeamboxError(f"frame {step.name} needs the pose number {place + 1}, but there are {len(poses)}")
            pose = poses.matrices[place]
            time = float(poses.times[place] - poses.times[0]) if poses.times is not None else time
        elif poses is not None:
            pose = poses()
        if times is not None:
            if k >= len(times):
                raise BeamboxError(f"there are {len(times)} times, but more sweeps")
            time = times[k]
        yield step, tracker.update(step.detections, time, pose)
