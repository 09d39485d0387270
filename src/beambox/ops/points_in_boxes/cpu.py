"""Which points lie in which boxes, box after box, behind an axis-aligned test (numba)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit
from beambox.ops.points_in_boxes.reference import TOLERANCE

__all__ = ["points_in_boxes", "points_in_boxes_mask"]


def points_in_boxes(points: Tensor, boxes: Tensor) -> Tensor:
    """Find the first box of each point; see :func:`beambox.ops.points_in_boxes.points_in_boxes`."""
    owner = np.full(len(points), -1, np.int64)
    _own(points[:, :3].contiguous().numpy(), _prepare(boxes), owner)
    return torch.from_numpy(owner)


def points_in_boxes_mask(points: Tensor, boxes: Tensor) -> Tensor:
    """Tell for all pairs; see :func:`beambox.ops.points_in_boxes.points_in_boxes_mask`."""
    mask = np.zeros((len(boxes), len(points)), np.bool_)
    _mark(points[:, :3].contiguous().numpy(), _prepare(boxes), mask)
    return torch.from_numpy(mask)


def _prepare(boxes: Tensor) -> np.ndarray:
    """Return one row per box: centre (3), half sizes with tolerance (3), cosine, sine, half extent in x and y."""
    boxes = boxes.double()
    half = boxes[:, 3:6] / 2 + TOLERANCE
    cos, sin = boxes[:, 6].cos(), boxes[:, 6].sin()
    x = cos.abs() * half[:, 0] + sin.abs() * half[:, 1]
    y = sin.abs() * half[:, 0] + cos.abs() * half[:, 1]
    margin = 1e-6  # the axis-aligned test must never be stricter than the exact one
    rest = torch.stack((cos, sin, x + margin, y + margin), dim=1)
    return torch.cat((boxes[:, :3], half, rest), dim=1).numpy()


@jit
def _own(points, boxes, owner):
    """Write the first box of each point into ``owner``, where there is one."""
    for b in range(len(boxes)):
        x, y, z, length, width, height = boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5]
        cos, sin, extent_x, extent_y = boxes[b, 6], boxes[b, 7], boxes[b, 8], boxes[b, 9]
        for i in range(len(points)):
            dx, dy = points[i, 0] - x, points[i, 1] - y
            if abs(dx) <= extent_x and abs(dy) <= extent_y and owner[i] < 0:
                along, across = cos * dx + sin * dy, cos * dy - sin * dx
                if abs(along) <= length and abs(across) <= width and abs(points[i, 2] - z) <= height:
                    owner[i] = b


@jit
def _mark(points, boxes, mask):
    """Write into ``mask`` (M, N), all False, which points lie in which boxes."""
    for b in range(len(boxes)):
        x, y, z, length, width, height = boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3], boxes[b, 4], boxes[b, 5]
        cos, sin, extent_x, extent_y = boxes[b, 6], boxes[b, 7], boxes[b, 8], boxes[b, 9]
        for i in range(len(points)):
            dx, dy = points[i, 0] - x, points[i, 1] - y
            if abs(dx) <= extent_x and abs(dy) <= extent_y:
                along, across = cos * dx + sin * dy, cos * dy - sin * dx
                mask[b, i] = abs(along) <= length and abs(across) <= width and abs(points[i, 2] - z) <= height
