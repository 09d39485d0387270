"""Where the axes of some points lead, and how to carry points and boxes to x forward, y left, z up."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean

__all__ = ["Axes", "level_shift", "turn_boxes"]

# direction -> (row of the LiDAR frame x forward, y left, z up; sign)
_DIRECTIONS = {
    "forward": (0, 1.0),
    "backward": (0, -1.0),
    "left": (1, 1.0),
    "right": (1, -1.0),
    "up": (2, 1.0),
    "down": (2, -1.0),
}
_EXAMPLE = '"x: right, y: forward"'


@dataclass(frozen=True)
class Axes:
    """Where the axes of some points lead, seen from the vehicle."""

    x: str = "forward"
    """Direction of +x: forward, backward, left, right, up or down."""
    y: str = "left"
    """Direction of +y."""
    z: str = "up"
    """Direction of +z."""

    def __post_init__(self) -> None:
        for direction in (self.x, self.y, self.z):
            if direction not in _DIRECTIONS:
                raise BeamboxError(f'unknown direction "{direction}" in axes{did_you_mean(direction, _DIRECTIONS)}')
        if {_DIRECTIONS[d][0] for d in (self.x, self.y, self.z)} != {0, 1, 2}:
            raise BeamboxError(
                f"axes must lead along three different lines, got x: {self.x}, y: {self.y}, z: {self.z}; "
                f"for example {_EXAMPLE}"
            )

    @classmethod
    def parse(cls, text: str) -> Axes:
        """Read ``"x: right, y: forward"``; z completes a right-handed frame where it is not given.

        Raises:
            BeamboxError: if x or y is absent, twice there, or leads nowhere known.
        """
        words = text.lower()
        for mark in ":=,;":
            words = words.replace(mark, f" {mark if mark in ':=' else ''} ")
        tokens = words.split()
        names, marks, directions = tokens[::3], tokens[1::3], tokens[2::3]
        found = dict(zip(names, directions))
        whole = len(names) == len(marks) == len(directions) == len(found) and set(marks) <= {":", "="}
        if not whole or not {"x", "y"} <= found.keys() <= {"x", "y", "z"}:
            raise BeamboxError(f"axes must say where x and y lead, for example {_EXAMPLE}, got {text!r}")
        if "z" not in found:
            for direction in _DIRECTIONS:
                try:
                    axes = cls(found["x"], found["y"], direction)
                except BeamboxError:
                    continue
                if axes.right_handed:
                    return axes
        return cls(found["x"], found["y"], found.get("z", "up"))

    @property
    def matrix(self) -> Tensor:
        """``(3, 3)`` float64: x forward, y left, z up = matrix @ given axes."""
        out = torch.zeros(3, 3, dtype=torch.float64)
        for column, direction in enumerate((self.x, self.y, self.z)):
            row, sign = _DIRECTIONS[direction]
            out[row, column] = sign
        return out

    @property
    def right_handed(self) -> bool:
        """Whether x, y and z are ordered as thumb, forefinger and middle finger of the right hand."""
        return bool(torch.linalg.det(self.matrix) > 0)

    @property
    def vertical_z(self) -> bool:
        """Whether z is the vertical, so that boxes can turn about it."""
        return _DIRECTIONS[self.z][0] == 2

    def __str__(self) -> str:
        return f"x: {self.x}, y: {self.y}, z: {self.z}"


def level_shift(rows: Tensor, z_offset: float, slope: tuple[float, float]) -> Tensor:
    """Return ``(N,)`` metres that bring z of points or boxes to another height and level the ground under them.

    Args:
        rows: ``(N, 2 or more)`` x forward, y left, in metres.
        z_offset: metres to add everywhere.
        slope: metres that the ground rises a metre forward and a metre to the left; taken away.
    """
    return z_offset - slope[0] * rows[:, 0] - slope[1] * rows[:, 1]


def turn_boxes(boxes: Tensor, matrix: Tensor) -> Tensor:
    """Carry centres and headings of ``(N, 7)`` boxes to other axes with the same vertical.

    Args:
        boxes: in the given axes.
        matrix: ``(3, 3)`` new = matrix @ given, as :attr:`Axes.matrix` or its transpose.
    """
    if torch.equal(matrix, torch.eye(3, dtype=matrix.dtype)):
        return boxes.clone()
    matrix = matrix.to(boxes)
    heading = torch.stack((boxes[:, 6].cos(), boxes[:, 6].sin()), dim=1) @ matrix[:2, :2].T
    yaw = torch.atan2(heading[:, 1], heading[:, 0])
    return torch.cat((boxes[:, :3] @ matrix.T, boxes[:, 3:6], yaw[:, None]), dim=1)
