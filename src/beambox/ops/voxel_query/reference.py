"""Voxel query as it is defined: every cell within reach of every point, looked up one after the other."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import torch
from torch import Tensor
from torch.nn import functional

from beambox.ops.sparse_conv import Sites, Triple, linear_keys

__all__ = ["pooled", "pooled_query", "voxel_query"]


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
    *,
    search: Callable[..., Tensor] = voxel_query,
) -> Tensor:
    """Find by ``search``, gather and take the maximum, one after the other."""
    found = search(points, cells, sites, centers, query_range, radius, max_samples)
    return pooled(points, centers, found, features, lambda away: functional.linear(away, weight, bias))


def pooled(
    points: Tensor, centers: Tensor, found: Tensor, features: Tensor, position: Callable[[Tensor], Tensor]
) -> Tensor:
    """Gather ``(M, S)`` rows that were found, and keep what the maximum and ReLU leave: ``(M, C)``.

    Args:
        points: ``(M, 3)``.
        centers: ``(V, 3)``.
        found: ``(M, S)`` rows, -1 where there are none.
        features: ``(V, C)``.
        position: from ways from point to voxel ``(M * S, 3)`` to ``(M * S, C)``.
    """
    none = found[:, :1] < 0
    row = found.clamp(min=0)
    if len(features) == 0:
        # the sum of no rows is zero and keeps every parameter in the graph, as processes in step need
        features, centers = features.sum(dim=0, keepdim=True), centers.new_zeros((1, 3))
    gathered = torch.where(none[..., None], 0.0, features[row])  # (M, S, C)
    away = torch.where(none[..., None], 0.0, centers[row] - points[:, None])  # (M, S, 3)
    placed = position(away.flatten(0, 1).to(features.dtype)).unflatten(0, found.shape)  # (M, S, C)
    return functional.relu((gathered + placed).amax(dim=1))  # ReLU and maximum commute
