"""Reductions over groups of rows, and rows to the cells of a map, in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["scatter_bev", "segment_max", "segment_mean", "segment_sum"]


def segment_sum(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Add the rows of each segment; see :func:`beambox.ops.scatter.segment_sum`."""
    return values.new_zeros(size, values.shape[1]).index_add(0, segment, values)


def segment_mean(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Average the rows of each segment; see :func:`beambox.ops.scatter.segment_mean`."""
    count = torch.bincount(segment, minlength=size).clamp(min=1).to(values.dtype)
    return segment_sum(values, segment, size) / count[:, None]


def segment_max(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Take the largest of each segment and column; see :func:`beambox.ops.scatter.segment_max`.

    The winner, the first row that holds the maximum, is found without a gradient; picking it carries the gradient.
    """
    rows, columns = values.shape
    target = segment[:, None].expand(rows, columns)
    with torch.no_grad():
        known = torch.where(values.isnan(), torch.inf, values)  # a NaN shall be seen, not skipped
        best = known.new_full((size, columns), -torch.inf).scatter_reduce(0, target, known, "amax")  # (S, C)
        row = torch.arange(rows, device=values.device)[:, None].expand(rows, columns)
        candidate = torch.where(known == best[segment], row, rows)  # (K, C)
        winner = row.new_full((size, columns), rows).scatter_reduce(0, target, candidate, "amin")  # (S, C)
    padded = torch.cat((values, values.new_zeros(1, columns)))  # empty segments pick the row of zeros
    return padded.gather(0, winner)


def scatter_bev(features: Tensor, index: Tensor, batch_size: int, size: tuple[int, int]) -> Tensor:
    """Lay voxel features onto a bird's-eye-view map; see :func:`beambox.ops.scatter.scatter_bev`."""
    ny, nx = size
    cell = (index[:, 0] * ny + index[:, 2]) * nx + index[:, 3]  # (V,)
    canvas = segment_sum(features, cell, batch_size * ny * nx)  # (B * ny * nx, C)
    return canvas.view(batch_size, ny, nx, -1).permute(0, 3, 1, 2)  # (B, C, ny, nx)
