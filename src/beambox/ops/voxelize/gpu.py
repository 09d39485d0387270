"""Voxelization for a GPU: the definition's result by sorts alone, the host waiting once, for the two sizes."""

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
    """Group points by cell; see :func:`beambox.ops.voxelize.voxelize`.

    Nothing is dropped before the end: points outside share a cell after all others, and numbers of voxels that do not
    exist come after those that do.
    """
    count, device = len(points), points.device
    if count == 0:
        nothing = torch.zeros(0, dtype=torch.int64, device=device)
        return Voxels(points, nothing, nothing, nothing.new_zeros(0, 4), batch_size, grid)
    nz, ny, nx = grid.shape
    none = batch_size * nz * ny * nx
    position, inside = grid.index(points)
    z, y, x = position.unbind(dim=1)
    key = torch.where(inside, ((sample * nz + z) * ny + y) * nx + x, none)
    key, scan = torch.sort(key, stable=True)  # (N,), and the points' rows, in scan order inside a cell
    row = torch.arange(count, device=device)

    begins = torch.ones(count, dtype=torch.bool, device=device)
    torch.ne(key[1:], key[:-1], out=begins[1:])
    run = begins.cumsum(0) - 1  # (N,) cells in ascending order, each a run of points
    start = row.new_full((count + 1,), count).scatter_(0, torch.where(begins, run, count), row)[:count]  # of each run
    at = start.clamp(max=count - 1)
    cell = torch.where(start < count, key[at], none)  # (N,) of each run
    of_sample = torch.where(cell < none, cell // (nz * ny * nx), batch_size)

    # Runs in the order of their first points, samples apart: their ranks are the voxels' numbers.
    order = torch.argsort(of_sample * (count + 1) + scan[at])
    number = torch.empty_like(order).scatter_(0, order, row)  # (N,) of each run
    first = torch.searchsorted(of_sample[order].contiguous(), torch.arange(batch_size + 1, device=device))  # (B + 1,)
    exists = cell < none
    if max_voxels is not None:
        kept_of = (first[1:] - first[:-1]).clamp(max=max_voxels)  # (B,)
        before = torch.nn.functional.pad(kept_of.cumsum(0), (1, 0))  # (B + 1,) kept voxels of the samples before
        place = number - first[of_sample]
        exists = exists & (place < max_voxels)
        number = before[of_sample] + place
    depth = row - start[run]  # (N,) points of the cell before
    kept = exists[run] if max_points is None else exists[run] & (depth < max_points)
    voxel, by_voxel = torch.sort(torch.where(kept, number[run], count), stable=True)
    index = _indices(cell, torch.where(exists, number, count), count, grid)

    sizes = torch.stack((kept.sum(), exists.sum())).tolist()  # the host waits
    voxel, index = voxel[: sizes[0]], index[: sizes[1]]
    edges = torch.searchsorted(voxel, torch.arange(sizes[1] + 1, device=device))  # (V + 1,)
    return Voxels(points[scan[by_voxel[: sizes[0]]]], voxel, edges[1:] - edges[:-1], index, batch_size, grid)


def _indices(cell: Tensor, number: Tensor, count: int, grid: VoxelGrid) -> Tensor:
    """Return ``(N + 1, 4)`` (sample, z, y, x) by number of the voxel."""
    nz, ny, nx = grid.shape
    by_number = torch.zeros(count + 1, dtype=torch.int64, device=cell.device).scatter_(0, number, cell)
    rest, x = by_number // nx, by_number % nx
    rest, y = rest // ny, rest % ny
    return torch.stack((rest // nz, rest % nz, y, x), dim=1)
