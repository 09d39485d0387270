"""Which points lie in which boxes, in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["TOLERANCE", "points_in_boxes", "points_in_boxes_mask"]

TOLERANCE = 1e-9  # metres; a point on a face counts as inside, whatever rounding the rotation brings


def points_in_boxes(points: Tensor, boxes: Tensor) -> Tensor:
    """Find the first box of each point; see :func:`beambox.ops.points_in_boxes.points_in_boxes`."""
    owner = torch.full((len(points),), -1, dtype=torch.int64, device=points.device)
    for box in reversed(range(len(boxes))):  # backwards, so that the first box has the last word
        owner[_inside(points, boxes[box])] = box
    return owner


def points_in_boxes_mask(points: Tensor, boxes: Tensor) -> Tensor:
    """Tell for all pairs; see :func:`beambox.ops.points_in_boxes.points_in_boxes_mask`."""
    mask = torch.zeros(len(boxes), len(points), dtype=torch.bool, device=points.device)
    for box in range(len(boxes)):
        mask[box] = _inside(points, boxes[box])
    return mask


def _inside(points: Tensor, box: Tensor) -> Tensor:
    """Tell which ``(N, 3 or more)`` points lie in a ``(7,)`` box: ``(N,)`` bool."""
    box = box.double()
    dx, dy, dz = (points[:, :3].double() - box[:3]).unbind(dim=1)
    cos, sin = box[6].cos(), box[6].sin()
    along, across = cos * dx + sin * dy, cos * dy - sin * dx
    length, width, height = box[3:6] / 2 + TOLERANCE
    return (along.abs() <= length) & (across.abs() <= width) & (dz.abs() <= height)
