"""Voxel query as it is defined: every cell within reach of every point, looked up one after the other."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from beambox.ops.sparse_conv import Sites, Triple, linear_keys

__all__ = ["voxel_query"]


def voxel_query(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float, max_samples: int
) -> Tensor:
    """Find the first active voxels around each point; see :func:`beambox.ops.voxel_query.voxel_query`."""
    device = points.device
    found = torch.full((len(points), max_samples), -1, dtype=torch.int64, device=device)
    if len(sites) == 0 or len(points) == 0:
        return found
    count = torch.zeros(len(points), dtype=torch.int64, device=device)
    extent = torch.tensor((sites.batch_size, *sites.shape), device=device)
    limit = torch.tensor(radius, dtype=points.dtype, device=device) ** 2
    for dz, dy, dx in product(*(range(-r, r + 1) for r in query_range)):
        cell = cells + torch.tensor((0, dz, dy, dx), device=device)
        inside = ((cell >= 0) & (cell < extent)).all(dim=1)
        key = linear_keys(cell, sites.shape)
        slot = torch.searchsorted(sites.sorted_keys, key).clamp_(max=len(sites) - 1)
        row = sites.order[slot]
        offset = centers[row] - points
        distance = offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1] + offset[:, 2] * offset[:, 2]
        hit = inside & (sites.sorted_keys[slot] == key) & (distance <= limit) & (count < max_samples)
        point = torch.nonzero(hit)[:, 0]
        found[point, count[point]] = row[point]
        count[point] += 1
    empty = torch.arange(max_samples, device=device) >= count[:, None]  # (M, S)
    return torch.where(empty, found[:, :1], found)
