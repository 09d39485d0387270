"""Boxes with everything worked out once that overlaps need for each pair."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["prepare"]


def prepare(boxes: Tensor) -> Tensor:
    """Return one row per box: x, y, half length, half width, cosine, sine, radius, z, half height; ``(N, 9)`` float64.

    A box with a value that is not finite becomes one without size.
    """
    boxes = boxes.detach().double()
    half = boxes[:, 3:6].clamp(min=0) / 2
    x, y, z, yaw = boxes[:, 0], boxes[:, 1], boxes[:, 2], boxes[:, 6]
    columns = (x, y, half[:, 0], half[:, 1], yaw.cos(), yaw.sin(), half[:, :2].norm(dim=1), z, half[:, 2])
    rows = torch.stack(columns, dim=1)
    return torch.where(boxes.isfinite().all(dim=1, keepdim=True), rows, 0.0)
