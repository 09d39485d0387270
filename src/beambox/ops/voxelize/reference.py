"""Voxelization in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.geometry.grid import VoxelGrid
from beambox.ops.voxelize.voxels import Voxels

__all__ = ["voxelize"]


def voxelize(
    points: Tensor,
    sample: Tensor,
    batch_size: int,
    grid: VoxelGrid,
    max_points: int | None = None,
    max_voxels: int | None = None,
) -> Voxels:
    """Group points by cell; see :func:`beambox.ops.voxelize.voxelize`."""
    position, inside = grid.index(points)
    kept = inside.nonzero().squeeze(1)  # (K,) rows of `points`, in scan order
    cell = torch.cat((sample[kept, None], position[kept]), dim=1)  # (K, 4) sample, z, y, x
    voxel, index = _number_by_first_appearance(cell, grid)

    if max_voxels is not None:
        of_sample = torch.bincount(index[:, 0], minlength=batch_size)
        before = of_sample.cumsum(0) - of_sample  # (B,) voxels of the samples before
        allowed = torch.arange(len(index), device=index.device) - before[index[:, 0]] < max_voxels  # (V,)
        number = allowed.cumsum(0) - 1
        chosen = allowed[voxel]
        kept, voxel, index = kept[chosen], number[voxel[chosen]], index[allowed]

    by_voxel = voxel.argsort(stable=True)  # stable: scan order inside a voxel
    kept, voxel = kept[by_voxel], voxel[by_voxel]
    count = torch.bincount(voxel, minlength=len(index))
    if max_points is not None:
        start = count.cumsum(0) - count  # (V,)
        first = torch.arange(len(voxel), device=voxel.device) - start[voxel] < max_points
        kept, voxel, count = kept[first], voxel[first], count.clamp(max=max_points)
    return Voxels(points[kept], voxel, count, index, batch_size, grid)


def _number_by_first_appearance(cell: Tensor, grid: VoxelGrid) -> tuple[Tensor, Tensor]:
    """Number the distinct rows of ``(K, 4)`` cells by sample, then by first appearance: ``(K,)`` and ``(V, 4)``."""
    nz, ny, nx = grid.shape
    b, z, y, x = cell.unbind(dim=1)
    key = ((b * nz + z) * ny + y) * nx + x
    distinct, slot = key.unique(return_inverse=True)  # ascending, so by sample
    scan = torch.arange(len(key), device=key.device)
    first = scan.new_full((len(distinct),), len(key)).scatter_reduce(0, slot, scan, "amin")  # (V,)
    order = first.argsort()
    order = order[cell[first[order], 0].argsort(stable=True)]  # by sample; inside a sample by first appearance
    number = torch.empty_like(order)
    number[order] = torch.arange(len(order), device=order.device)
    return number[slot], cell[first[order]]
