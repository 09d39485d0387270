"""Do boxes lie where their points are, and if not, what mistake in units, axes, signs or order would explain it?"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from beambox.ops.points_in_boxes import points_in_boxes_mask
from beambox.structures import Frame

__all__ = ["AS_LABELED", "BEYOND_A_TURN", "MISTAKES", "count_filled", "up_axis"]

AS_LABELED = "as labelled"
BEYOND_A_TURN = 2 * math.pi + 0.05
"""No angle in radians needs to be larger than this."""
FILLED = 5
"""So many points above the ground make a box that holds something."""
ABOVE_GROUND = 0.3
"""Metres at a box's bottom that do not count: any box on the road holds the road."""


def _turned(boxes: Tensor, rows: tuple[tuple[float, float], tuple[float, float]]) -> Tensor:
    """Carry boxes to other axes in the plane; rows of a 2 x 2 matrix, which may mirror."""
    matrix = torch.tensor(rows, dtype=boxes.dtype)
    heading = torch.stack((boxes[:, 6].cos(), boxes[:, 6].sin()), dim=1) @ matrix.T
    out = boxes.clone()
    out[:, :2] = boxes[:, :2] @ matrix.T
    out[:, 6] = torch.atan2(heading[:, 1], heading[:, 0])
    return out


def _scaled(boxes: Tensor, factor: float) -> Tensor:
    out = boxes.clone()
    out[:, :6] *= factor
    return out


def _from_camera(boxes: Tensor) -> Tensor:
    """Read x right, y down, z forward and a rotation about y, the centre at the bottom."""
    x, y, z, length, width, height, yaw = boxes.unbind(dim=1)
    return torch.stack((z, -x, -y + height / 2, length, width, height, -yaw - math.pi / 2), dim=1)


def _degrees(boxes: Tensor) -> Tensor:
    out = boxes.clone()
    out[:, 6] = torch.deg2rad(boxes[:, 6])
    return out


OTHER_WAY = "of the boxes leads the other way than that of the points"
QUARTER = "the axes of boxes and points differ by a quarter turn"
MISTAKES: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "y mirrored": (lambda boxes: _turned(boxes, ((1, 0), (0, -1))), f"y {OTHER_WAY}"),
    "x mirrored": (lambda boxes: _turned(boxes, ((-1, 0), (0, 1))), f"x {OTHER_WAY}"),
    "x and y exchanged": (lambda boxes: _turned(boxes, ((0, 1), (1, 0))), "x and y are in the other order"),
    "turned by 90 degrees": (lambda boxes: _turned(boxes, ((0, -1), (1, 0))), QUARTER),
    "turned by -90 degrees": (lambda boxes: _turned(boxes, ((0, 1), (-1, 0))), QUARTER),
    "turned by 180 degrees": (lambda boxes: _turned(boxes, ((-1, 0), (0, -1))), "x and y lead the other way"),
    "read as camera axes": (
        _from_camera,
        "the boxes are in a camera's axes (x right, y down, z forward): format: kitti",
    ),
    "divided by 1000": (lambda boxes: _scaled(boxes, 1e-3), "the boxes are in millimetres, the points in metres"),
    "divided by 100": (lambda boxes: _scaled(boxes, 1e-2), "the boxes are in centimetres, the points in metres"),
    "times 1000": (lambda boxes: _scaled(boxes, 1e3), "the points are in millimetres, the boxes in metres"),
    "with sizes as h, w, l": (lambda boxes: boxes[:, [0, 1, 2, 5, 4, 3, 6]], "the sizes are in KITTI's order h, w, l"),
    "with yaw in degrees": (_degrees, "yaw is in degrees, radians are expected"),
}
"""Usual mistakes: what they would do to the boxes, and what they are called."""


def count_filled(frame: Frame) -> dict[str, tuple[int, int]]:
    """Count the boxes that hold points as they are labelled and as each usual mistake would have them.

    Returns:
        Boxes with at least a few points above the ground, and such points in all, by the names of :data:`MISTAKES` and
        :data:`AS_LABELED`.
    """
    assert frame.labels is not None
    given = frame.labels.boxes.double()
    xyz = frame.points[:, :3].double()
    found = {}
    for name, change in {AS_LABELED: lambda boxes: boxes, **{name: one[0] for name, one in MISTAKES.items()}}.items():
        boxes = change(given).clone()
        scale = 1e3 if name == "times 1000" else 1.0
        boxes[:, 2] += scale * ABOVE_GROUND / 2
        boxes[:, 5] = (boxes[:, 5] - scale * ABOVE_GROUND).clamp(min=0)
        counts = points_in_boxes_mask(xyz, boxes).sum(dim=1)
        found[name] = (int((counts >= FILLED).sum()), int(counts.sum()))
    return found


def up_axis(points: Tensor) -> str | None:
    """Return the axis that is up, such as "-y", or None where it is +z or cannot be told.

    Args:
        points: ``(N, 3 or more)``, metres.
    """
    xyz = points[:, :3].double().numpy()
    xyz = xyz[np.abs(xyz).max(axis=1) < 50]
    if len(xyz) < 500:
        return None
    spread = np.quantile(xyz, 0.95, axis=0) - np.quantile(xyz, 0.05, axis=0)
    axis = int(spread.argmin())
    if spread[axis] > 0.6 * np.sort(spread)[1]:
        return None  # no axis is clearly the thin one
    values = xyz[:, axis]
    counts, edges = np.histogram(values, bins=np.arange(np.floor(values.min()), np.ceil(values.max()) + 0.1, 0.1))
    ground = edges[counts.argmax()] + 0.05
    # The ground is the densest layer, and what stands on it reaches farther than what lies below it.
    above, below = np.quantile(values, 0.98) - ground, ground - np.quantile(values, 0.02)
    sign = "+" if above >= below else "-"
    found = sign + "xyz"[axis]
    return None if found == "+z" else found
