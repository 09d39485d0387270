"""How many voxels lie around each voxel, by looking at all pairs, in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["TOLERANCE", "ball_count", "ball_counts"]

TOLERANCE = 1e-6  # square metres; a centre at the radius counts, whatever its decimals round to
ROWS_AT_ONCE = 256  # bounds the memory of the pairs


def ball_counts(
    index: Tensor, cell: tuple[float, float, float], radii: tuple[float, ...], extent: object = None
) -> Tensor:
    """Count for several radii; see :func:`beambox.ops.ball_count.ball_counts`."""
    return torch.stack([ball_count(index, cell, radius) for radius in radii], dim=1)


def ball_count(index: Tensor, cell: tuple[float, float, float], radius: float) -> Tensor:
    """Count the voxels within a radius; see :func:`beambox.ops.ball_count.ball_count`."""
    squared_cell = torch.tensor(cell, dtype=torch.float64, device=index.device) ** 2  # x, y, z
    voxels = index.unique(dim=0)  # (U, 4)
    counts = []
    for rows in index.split(ROWS_AT_ONCE):
        sample, z, y, x = (rows[:, None] - voxels).unbind(dim=2)  # (R, U) differences
        squared = x * x * squared_cell[0] + y * y * squared_cell[1] + z * z * squared_cell[2]
        near = (squared <= radius * radius + TOLERANCE) & (sample == 0)
        counts.append(near.sum(dim=1))
    return torch.cat(counts)
