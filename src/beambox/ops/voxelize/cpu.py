"""Voxelization by one pass over the points and a hash table of cells (numba)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beambox.geometry.grid import VoxelGrid
from beambox.ops.jit import jit
from beambox.ops.voxelize.voxels import Voxels

__all__ = ["voxelize"]

NO_LIMIT = np.iinfo(np.int64).max


def voxelize(
    points: Tensor,
    sample: Tensor,
    batch_size: int,
    grid: VoxelGrid,
    max_points: int | None = None,
    max_voxels: int | None = None,
) -> Voxels:
    """Group points by cell; see :func:`beambox.ops.voxelize.voxelize`."""
    array = points.detach().contiguous().numpy()
    order, voxel, count, index = _group(
        array,
        sample.contiguous().numpy(),
        batch_size,
        np.array(grid.minimum, array.dtype),  # in the points' own precision, as VoxelGrid.index computes
        np.array(grid.cell, array.dtype),
        np.array(grid.size, np.int64),
        NO_LIMIT if max_points is None else max_points,
        NO_LIMIT if max_voxels is None else max_voxels,
    )
    kept = points[torch.from_numpy(order)]
    return Voxels(kept, torch.from_numpy(voxel), torch.from_numpy(count), torch.from_numpy(index), batch_size, grid)


@jit
def _group(points, sample, batch_size, minimum, cell, size, max_points, max_voxels):
    """Return the kept rows in order of voxel (K,), their voxels (K,), and count (V,) and index (V, 4) of the voxels."""
    n = len(points)
    nx, ny, nz = size[0], size[1], size[2]
    bits = 4
    while (1 << bits) < 2 * n:
        bits += 1
    table_key = np.full(1 << bits, -1, np.int64)
    table_voxel = np.empty(1 << bits, np.int64)
    mask = (1 << bits) - 1

    found = np.full(n, -1, np.int64)  # voxel of each point, numbered as the voxels appear; -1 where dropped
    count = np.zeros(n, np.int64)
    index = np.empty((n, 4), np.int64)
    voxels_of = np.zeros(batch_size, np.int64)
    voxels = 0
    for i in range(n):
        fx = np.floor((points[i, 0] - minimum[0]) / cell[0])
        fy = np.floor((points[i, 1] - minimum[1]) / cell[1])
        fz = np.floor((points[i, 2] - minimum[2]) / cell[2])
        if not (fx >= 0 and fx < nx and fy >= 0 and fy < ny and fz >= 0 and fz < nz):
            continue
        b, z, y, x = sample[i], np.int64(fz), np.int64(fy), np.int64(fx)
        key = ((b * nz + z) * ny + y) * nx + x
        slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - bits))
        while table_key[slot] != key and table_key[slot] != -1:
            slot = (slot + 1) & mask
        if table_key[slot] == -1:
            table_key[slot] = key
            if voxels_of[b] < max_voxels:
                voxels_of[b] += 1
                table_voxel[slot] = voxels
                index[voxels, 0], index[voxels, 1], index[voxels, 2], index[voxels, 3] = b, z, y, x
                voxels += 1
            else:
                table_voxel[slot] = -1
        voxel = table_voxel[slot]
        if voxel >= 0 and count[voxel] < max_points:
            found[i] = voxel
            count[voxel] += 1
    return _sort(found, count[:voxels], index[:voxels], batch_size)


@jit
def _sort(found, count, index, batch_size):
    """Renumber voxels by sample, keeping their order inside it, and sort the points by voxel, keeping theirs."""
    next_of = np.zeros(batch_size + 1, np.int64)
    for v in range(len(index)):
        next_of[index[v, 0] + 1] += 1
    for b in range(batch_size):
        next_of[b + 1] += next_of[b]
    rank = np.empty(len(index), np.int64)
    sorted_count = np.empty(len(index), np.int64)
    sorted_index = np.empty((len(index), 4), np.int64)
    for v in range(len(index)):
        rank[v] = next_of[index[v, 0]]
        next_of[index[v, 0]] += 1
        sorted_count[rank[v]] = count[v]
        sorted_index[rank[v]] = index[v]

    place = np.empty(len(index), np.int64)
    kept = 0
    for v in range(len(index)):
        place[v] = kept
        kept += sorted_count[v]
    order = np.empty(kept, np.int64)
    voxel = np.empty(kept, np.int64)
    for i in range(len(found)):
        if found[i] >= 0:
            v = rank[found[i]]
            order[place[v]] = i
            voxel[place[v]] = v
            place[v] += 1
    return order, voxel, sorted_count, sorted_index
