"""Voxel query on the CPU: rows of the grid are found by a table, cells of a row by walking it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit, parallel_for
from beambox.ops.sparse_conv import Sites, Triple

__all__ = ["pooled_query", "voxel_query"]


class _Query(NamedTuple):
    """What is looked for, and among what."""

    points: np.ndarray
    cells: np.ndarray
    centers: np.ndarray
    lines: np.ndarray
    """Where the voxels of each line along x begin, in ascending order of keys."""
    column: np.ndarray
    """``(V,)`` x of each, in that order."""
    order: np.ndarray
    """``(V,)`` row of each."""
    extent: np.ndarray
    """Samples, z, y, x of the grid."""
    query_range: np.ndarray
    limit: float
    """Largest squared distance."""


def _prepared(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float
) -> _Query:
    keys = sites.sorted_keys.numpy()
    line = keys // sites.shape[2]
    lines = np.zeros(sites.batch_size * sites.shape[0] * sites.shape[1] + 1, np.int64)
    np.cumsum(np.bincount(line, minlength=len(lines) - 1), out=lines[1:])
    p, c, m = points.contiguous().numpy(), cells.contiguous().numpy(), centers.contiguous().numpy()
    extent = np.array((sites.batch_size, *sites.shape))
    column, limit = keys - line * sites.shape[2], p.dtype.type(radius) ** 2
    return _Query(p, c, m, lines, column, sites.order.numpy(), extent, np.array(query_range), limit)


def voxel_query(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float, max_samples: int
) -> Tensor:
    """Find the first active voxels around each point; see :func:`beambox.ops.voxel_query.voxel_query`."""
    found = np.full((len(points), max_samples), -1, np.int64)
    if len(sites) == 0 or len(points) == 0:
        return torch.from_numpy(found)
    query = _prepared(points, cells, sites, centers, query_range, radius)
    parallel_for(lambda first, last: _search(query, found, first, last), len(points), 256)
    return torch.from_numpy(found)


def pooled_query(
    points: Tensor,
    cells: Tensor,
    sites: Sites,
    centers: Tensor,
    query_range: Triple,
    radius: float,
    max_samples: int,
    features: Tensor,
    weight: Tensor,
    bias: Tensor,
) -> Tensor:
    """Pool what is found as it is found; see :func:`beambox.ops.voxel_query.pooled_query`."""
    if len(sites) == 0 or len(points) == 0:
        return torch.relu(bias).expand(len(points), -1).contiguous()
    query = _prepared(points, cells, sites, centers, query_range, radius)
    out = torch.empty(len(points), len(bias))
    values, result = features.contiguous().numpy(), out.numpy()
    slopes, shift = weight.t().contiguous().numpy(), bias.contiguous().numpy()
    parallel_for(lambda a, b: _pool(query, max_samples, values, slopes, shift, result, a, b), len(points), 256)
    return out


@jit
def _near(query, i, near):
    """Write the rows that a point finds to ``near``; return how many there are."""
    cells, extent, query_range, order, column = query.cells, query.extent, query.query_range, query.order, query.column
    points, centers, lines = query.points, query.centers, query.lines
    b, z, y, x = cells[i]
    if b < 0 or b >= extent[0]:
        return 0
    # out of reach of the grid; the indices may be any, so nothing may be added to them before this is known
    if z < -query_range[0] or y < -query_range[1] or x < -query_range[2]:
        return 0
    if z - extent[1] >= query_range[0] or y - extent[2] >= query_range[1] or x - extent[3] >= query_range[2]:
        return 0
    n = 0
    for cz in range(max(0, z - query_range[0]), min(extent[1], z + query_range[0] + 1)):
        for cy in range(max(0, y - query_range[1]), min(extent[2], y + query_range[1] + 1)):
            line = (b * extent[1] + cz) * extent[2] + cy
            at, stop = lines[line], lines[line + 1]
            if stop - at > 8:
                at += np.searchsorted(column[at:stop], x - query_range[2])
            while at < stop and column[at] <= x + query_range[2] and n < len(near):
                if column[at] >= x - query_range[2]:
                    row = order[at]
                    dx = centers[row, 0] - points[i, 0]
                    dy = centers[row, 1] - points[i, 1]
                    dz = centers[row, 2] - points[i, 2]
                    if dx * dx + dy * dy + dz * dz <= query.limit:
                        near[n] = row
                        n += 1
                at += 1
    return n


@jit
def _search(query, found, first, last):
    for i in range(first, last):
        n = _near(query, i, found[i])
        if n > 0:
            found[i, n:] = found[i, 0]


@jit
def _pool(query, max_samples, features, slopes, shift, out, first, last):
    near = np.empty(max_samples, np.int64)
    zero = np.float32(0.0)
    for i in range(first, last):
        n = _near(query, i, near)
        best = out[i]
        for c in range(len(shift)):
            best[c] = -np.inf if n > 0 else shift[c]
        for k in range(n):
            row = features[near[k]]
            dx = query.centers[near[k], 0] - query.points[i, 0]
            dy = query.centers[near[k], 1] - query.points[i, 1]
            dz = query.centers[near[k], 2] - query.points[i, 2]
            for c in range(len(shift)):
                value = row[c] + (dx * slopes[0, c] + dy * slopes[1, c] + dz * slopes[2, c] + shift[c])
                if not (best[c] >= value or best[c] != best[c]):  # a NaN is kept
                    best[c] = value
        for c in range(len(shift)):
            best[c] = zero if best[c] < zero else best[c]  # a NaN is kept
