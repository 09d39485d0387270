"""Simulated sweeps in ONCE's layout: its axes, its five classes, sequences of independent scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError
from beambox.data.once import write_once_sequence, write_once_split
from beambox.geometry.axes import Axes, turn_boxes
from beambox.io import read_json
from beambox.simulate.frames import simulate_frame
from beambox.simulate.object_mix import ONCE_MIX
from beambox.structures.frame import Frame
from beambox.structures.labels import Labels

__all__ = ["ONCE_AXES", "OnceFiles", "in_once_axes"]

ONCE_AXES = Axes("left", "backward")
"""Where ONCE's x and y lead."""


# Names of ONCE's seven cameras and where they roughly look, degrees to the left of ahead. There are no pictures, but
# the public toolbox wants each camera's calibration.
_CAMERAS = {"cam01": 0, "cam03": 180, "cam05": 135, "cam06": 45, "cam07": -45, "cam08": -135, "cam09": 0}


def _calibrations() -> dict[str, dict[str, list]]:
    """Pinhole cameras of 1920 x 1020 pixels at the sensor."""
    found = {}
    for name, degrees in _CAMERAS.items():
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        # columns: where the camera's right, down and forward lead, in ONCE's axes
        pose = [[-c, 0.0, s, 0.0], [-s, 0.0, -c, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        intrinsic = [[950.0, 0.0, 960.0], [0.0, 950.0, 510.0], [0.0, 0.0, 1.0]]
        found[name] = {"cam_to_velo": pose, "cam_intrinsic": intrinsic, "distortion": [0.0] * 8}
    return found


def in_once_axes(frame: Frame) -> Frame:
    """Turn a frame of the LiDAR frame (x forward, y left) to ONCE's axes and drop its camera."""
    turn = ONCE_AXES.matrix.T.float()
    points = frame.points.clone()
    points[:, :3] = points[:, :3] @ turn.T
    labels = frame.labels and Labels(turn_boxes(frame.labels.boxes, turn), frame.labels.names)
    return replace(frame, points=points, labels=labels, calibration=None, image_size=None)


@dataclass(frozen=True)
class OnceFiles:
    """ONCE's layout: a task is the frames of one sequence, whose JSON file comes last and marks it as whole."""

    out: str
    """Folder."""
    seed: int
    """Of the data set."""
    options: dict[str, Any]
    """Further arguments of :func:`simulate_frame`."""
    val_share: float
    """Share of the sequences for validation."""
    length: int
    """Frames in a sequence; only the last one may have fewer."""

    def missing(self, frames: int) -> list[range]:
        """Frames of each sequence that is not there yet or too short."""
        tasks = [range(i, min(i + self.length, frames)) for i in range(0, frames, self.length)]
        return [task for task in tasks if self._written(task.start // self.length) < len(task)]

    def write(self, task: range) -> int:
        """Simulate and write one sequence."""
        frames = (in_once_axes(simulate_frame(self.seed, i, object_mix=ONCE_MIX, **self.options)) for i in task)
        return write_once_sequence(self.out, f"{task.start // self.length:06d}", frames, _calibrations())

    def write_splits(self) -> None:
        """List the sequences that are whole; which of them are for validation depends on their number alone."""
        names = sorted(path.parent.name for path in (Path(self.out) / "data").glob("*/*.json"))
        write_once_split(self.out, "train", [name for name in names if not self._validates(int(name))])
        write_once_split(self.out, "val", [name for name in names if self._validates(int(name))])

    def _validates(self, sequence: int) -> bool:
        """Spread validation evenly over the sequences, beginning with the second."""
        return math.ceil(sequence * self.val_share) > math.ceil((sequence - 1) * self.val_share) and sequence > 0

    def _written(self, sequence: int) -> int:
        path = Path(self.out) / "data" / f"{sequence:06d}" / f"{sequence:06d}.json"
        if not path.exists():
            return 0
        try:
            return len(read_json(path)["frames"])
        except (ValueError, LookupError, TypeError) as error:
            raise BeamboxError(f"{path} is no sequence of ONCE ({error}); delete it or give another folder") from None
