"""Make another sensor's points look like those the weights were trained on, and carry the boxes back."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean
from beambox.structures import Detections, Frame

__all__ = ["Axes", "Corrections"]

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
        pairs = re.findall(r"([xyz])\s*[:=]\s*([a-z]+)", text.lower())
        found = dict(pairs)
        rest = re.sub(r"[xyz]\s*[:=]\s*[a-z]+|[\s,;]", "", text.lower())
        if rest or len(found) != len(pairs) or not {"x", "y"} <= found.keys():
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


@dataclass(frozen=True)
class Corrections:
    """What has to be done to points before the network sees them; the defaults do nothing."""

    axes: Axes = Axes()
    """Where the axes of the points lead."""
    raise_by: float = 0.0
    """Metres added to z: this sensor's height above the ground less that of the training data's."""

    @property
    def nothing(self) -> bool:
        """Whether points stay as they are."""
        return self == Corrections()

    def apply(self, frame: Frame) -> Frame:
        """Return the frame as the network is to see it."""
        if self.nothing:
            return frame
        points = frame.points.clone()
        points[:, :3] = points[:, :3] @ self.axes.matrix.T.to(points)
        points[:, 2] += self.raise_by
        return frame.with_points(points)

    def carry_back(self, detections: Detections) -> Detections:
        """Bring boxes into the frame of the points as they were given.

        Where the given z is not vertical, a box cannot turn about it: boxes then stay in x forward, y left, z up.
        """
        boxes = detections.boxes.clone()
        boxes[:, 2] -= self.raise_by
        if self.axes.vertical_z:
            boxes = _turned(boxes, self.axes.matrix.T)  # the inverse of a rotation is its transpose
        return replace(detections, boxes=boxes)

    def carry_forward(self, boxes: Tensor) -> Tensor:
        """Bring ``(N, 7)`` boxes of the given frame to where :meth:`apply` brings its points."""
        boxes = _turned(boxes, self.axes.matrix) if self.axes.vertical_z else boxes.clone()
        boxes[:, 2] += self.raise_by
        return boxes


def _turned(boxes: Tensor, matrix: Tensor) -> Tensor:
    """Carry centres and headings to other axes with the same vertical."""
    if torch.equal(matrix, torch.eye(3, dtype=matrix.dtype)):
        return boxes.clone()
    matrix = matrix.to(boxes)
    heading = torch.stack((boxes[:, 6].cos(), boxes[:, 6].sin()), dim=1) @ matrix[:2, :2].T
    yaw = torch.atan2(heading[:, 1], heading[:, 0])
    return torch.cat((boxes[:, :3] @ matrix.T, boxes[:, 3:6], yaw[:, None]), dim=1)
