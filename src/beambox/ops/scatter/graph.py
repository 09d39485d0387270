"""Reductions over groups of rows for a graph that is being exported: no checks, no gradient, operators of ONNX only.

All of them scatter single elements. ONNX can scatter whole rows too, but onnxruntime does so on several threads at
once, and rows that meet are then lost.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["scatter_bev", "segment_max", "segment_mean", "segment_sum"]


def segment_sum(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Add the rows of each segment; see :func:`beambox.ops.scatter.segment_sum`."""
    return values.new_zeros(size, values.shape[1]).scatter_add(0, segment[:, None].expand_as(values), values)


def segment_mean(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Average the rows of each segment; see :func:`beambox.ops.scatter.segment_mean`."""
    count = segment_sum(torch.ones_like(values[:, :1]), segment, size)  # (S, 1)
    return segment_sum(values, segment, size) / count.clamp(min=1)


def segment_max(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Take the largest of each segment and column; see :func:`beambox.ops.scatter.segment_max`."""
    lowest = values.new_full((size, values.shape[1]), -torch.inf)
    best = lowest.scatter_reduce(0, segment[:, None].expand_as(values), values, "amax")  # (S, C)
    return torch.where(best == -torch.inf, torch.zeros_like(best), best)  # empty segments are zero


def scatter_bev(features: Tensor, index: Tensor, batch_size: int, size: tuple[int, int]) -> Tensor:
    """Lay voxel features onto a bird's-eye-view map; see :func:`beambox.ops.scatter.scatter_bev`."""
    ny, nx = size
    cell = (index[:, 0] * ny + index[:, 2]) * nx + index[:, 3]  # (V,)
    canvas = segment_sum(features, cell, batch_size * ny * nx)  # (B * ny * nx, C)
    return canvas.view(batch_size, ny, nx, -1).permute(0, 3, 1, 2)  # (B, C, ny, nx)
