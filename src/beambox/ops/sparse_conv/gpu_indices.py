"""Indices of sites from their keys on a GPU (Triton)."""
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

__all__ = ["indices_of"]


def indices_of(keys: Tensor, order: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return ``(V, 4)`` int64 (b, z, y, x) of each row; see ``sites.indices_of``."""
    indices = torch.empty((len(keys), 4), dtype=torch.int64, device=keys.device)
    if len(keys):
        _take_apart[(triton.cdiv(len(keys), 256),)](keys, order, indices, len(keys), *shape, 256)
    return indices


@triton.jit
def _take_apart(keys, order, indices, rows, nz, ny, nx, block: tl.constexpr):
    """Write the four indices of a block of keys."""
    at = tl.program_id(0) * block + tl.arange(0, block)
    has = at < rows
    key = tl.load(keys + at, has, 0)
    place = indices + tl.load(order + at, has, 0) * 4
    tl.store(place, key // nx // ny // nz, has)
    tl.store(place + 1, key // nx // ny % nz, has)
    tl.store(place + 2, key // nx % ny, has)
    tl.store(place + 3, key % nx, has)
