"""Rows, keys and maps of sites for a graph that is being exported; see :mod:`beambox.ops.sparse_conv.graph`."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["indices_of", "to_bev"]


def indices_of(keys: Tensor, order: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return ``(V, 4)`` int64 (b, z, y, x) of each row from ``(V,)`` ascending keys and the row of each."""
    place = torch.zeros_like(order).scatter(0, order, torch.arange(order.shape[0], device=order.device))
    keys = keys[place]
    nz, ny, nx = shape
    rest, x = keys // nx, keys % nx
    rest, y = rest // ny, rest % ny
    return torch.stack((rest // nz, rest % nz, y, x), dim=1)


def to_bev(features: Tensor, indices: Tensor, shape: tuple[int, int, int], batch_size: int) -> Tensor:
    """Stack the height levels into channels; see :meth:`SparseTensor.to_bev`."""
    z, y, x = shape
    b, level, row, column = indices.unbind(dim=1)
    cell = ((b * z + level) * y + row) * x + column  # (V,)
    cells = features.new_zeros(batch_size * z * y * x, features.shape[1])
    cells = cells.scatter(0, cell[:, None].expand_as(features), features)  # each its own place
    bev = cells.view(batch_size, z, y, x, -1).permute(0, 4, 1, 2, 3)  # (B, C, Z, Y, X)
    return bev.flatten(1, 2)
