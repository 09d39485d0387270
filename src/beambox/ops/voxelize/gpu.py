"""Voxelization for a GPU: the definition's result by sorts, the host waiting once, for the two sizes.

Cells are found by a kernel (Triton) whose division rounds as the definition's does; sorts and sums are PyTorch's own.
"""
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.geometry.constants import constant
from beambox.geometry.grid import VoxelGrid
from beambox.ops.sparse_conv.gpu_indices import indices_of
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
    key = torch.empty(count, dtype=torch.int64, device=device)
    borders = constant((*grid.minimum, *grid.cell), device, points.dtype)
    given, kind = points.detach(), points.dtype == torch.float32
    _find_cells[(triton.cdiv(count, 256),)](
        given, sample, borders, key, count, *given.stride(), none, nz, ny, nx, kind, 256
    )
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
    by_number = torch.zeros(count + 1, dtype=torch.int64, device=device)  # cells, and one that takes all the others
    by_number.scatter_(0, torch.where(exists, number, count), cell)

    sizes = torch.stack((kept.sum(), exists.sum())).tolist()  # the host waits
    voxel, index = voxel[: sizes[0]], indices_of(by_number[: sizes[1]], row[: sizes[1]], grid.shape)
    edges = torch.searchsorted(voxel, torch.arange(sizes[1] + 1, device=device))  # (V + 1,)
    return Voxels(points[scan[by_voxel[: sizes[0]]]], voxel, edges[1:] - edges[:-1], index, batch_size, grid)


@triton.jit
def _find_cells(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    points, sample, borders, key, count, row_step, column_step, none, nz, ny, nx, single: tl.constexpr,
    block: tl.constexpr,
):  # fmt: skip
    """Write the linear position of each point's cell, ``none`` where it lies outside."""
    at = tl.program_id(0) * block + tl.arange(0, block)
    has = at < count
    place = points + at.to(tl.int64) * row_step
    x = _steps(place, borders, has, 0, column_step, single)
    y = _steps(place, borders, has, 1, column_step, single)
    z = _steps(place, borders, has, 2, column_step, single)
    inside = has & (x >= 0) & (x < nx) & (y >= 0) & (y < ny) & (z >= 0) & (z < nz)  # NaN lies outside
    x, y, z = (
        tl.where(inside, x, 0.0).to(tl.int64),
        tl.where(inside, y, 0.0).to(tl.int64),
        tl.where(inside, z, 0.0).to(tl.int64),
    )
    cell = ((tl.load(sample + at, has, 0) * nz + z) * ny + y) * nx + x
    tl.store(key + at, tl.where(inside, cell, none), has)


@triton.jit
def _steps(place, borders, has, axis: tl.constexpr, column_step, single: tl.constexpr):
    """Count whole cells from the border, as a floating-point number."""
    away = tl.load(place + axis * column_step, has, 0.0) - tl.load(borders + axis)
    edge = tl.load(borders + 3 + axis)
    if single:
        return tl.floor(tl.div_rn(away, edge + tl.zeros_like(away)))
    else:
        return tl.floor(away / edge)
