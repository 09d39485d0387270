"""Voxel query on the CPU: rows of the grid are found by a table, cells of a row by walking it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit, parallel_for
from beambox.ops.sparse_conv import Sites, Triple

__all__ = ["voxel_query"]


def voxel_query(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float, max_samples: int
) -> Tensor:
    """Find the first active voxels around each point; see :func:`beambox.ops.voxel_query.voxel_query`."""
    found = np.full((len(points), max_samples), -1, np.int64)
    if len(sites) == 0 or len(points) == 0:
        return torch.from_numpy(found)
    keys, order = sites.sorted_keys.numpy(), sites.order.numpy()
    line = keys // sites.shape[2]
    lines = np.zeros(sites.batch_size * sites.shape[0] * sites.shape[1] + 1, np.int64)
    np.cumsum(np.bincount(line, minlength=len(lines) - 1), out=lines[1:])
    column = keys - line * sites.shape[2]
    p, c, m = points.contiguous().numpy(), cells.contiguous().numpy(), centers.contiguous().numpy()
    extent = np.array((sites.batch_size, *sites.shape))
    limit = p.dtype.type(radius) ** 2
    around = np.array(query_range)
    parallel_for(
        lambda first, last: _search(p, c, m, lines, column, order, extent, around, limit, found, first, last),
        len(points),
        256,
    )
    return torch.from_numpy(found)


@jit
def _search(points, cells, centers, lines, column, order, extent, query_range, limit, found, first, last):
    max_samples = found.shape[1]
    for i in range(first, last):
        b, z, y, x = cells[i]
        if b < 0 or b >= extent[0]:
            continue
        # out of reach of the grid; the indices may be any, so nothing may be added to them before this is known
        if z < -query_range[0] or y < -query_range[1] or x < -query_range[2]:
            continue
        if z - extent[1] >= query_range[0] or y - extent[2] >= query_range[1] or x - extent[3] >= query_range[2]:
            continue
        n = 0
        for cz in range(max(0, z - query_range[0]), min(extent[1], z + query_range[0] + 1)):
            for cy in range(max(0, y - query_range[1]), min(extent[2], y + query_range[1] + 1)):
                line = (b * extent[1] + cz) * extent[2] + cy
                at, stop = lines[line], lines[line + 1]
                if stop - at > 8:
                    at += np.searchsorted(column[at:stop], x - query_range[2])
                while at < stop and column[at] <= x + query_range[2] and n < max_samples:
                    if column[at] >= x - query_range[2]:
                        row = order[at]
                        dx = centers[row, 0] - points[i, 0]
                        dy = centers[row, 1] - points[i, 1]
                        dz = centers[row, 2] - points[i, 2]
                        if dx * dx + dy * dy + dz * dz <= limit:
                            found[i, n] = row
                            n += 1
                    at += 1
        for rest in range(max(n, 1), max_samples):
            found[i, rest] = found[i, 0]
