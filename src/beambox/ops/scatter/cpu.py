"""The maximum over groups of rows in one pass, remembering the winners for the gradient (numba)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beambox.ops.jit import jit

__all__ = ["segment_max"]


def segment_max(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Take the largest of each segment and column; see :func:`beambox.ops.scatter.segment_max`."""
    return _SegmentMax.apply(values, segment, size)


class _SegmentMax(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, segment: Tensor, size: int) -> Tensor:
        out = torch.zeros(size, values.shape[1], dtype=values.dtype)
        winner = np.full((size, values.shape[1]), -1, np.int64)
        _largest(values.detach().contiguous().numpy(), segment.contiguous().numpy(), out.numpy(), winner)
        ctx.winner, ctx.rows = winner, len(values)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, None, None]:
        out = torch.zeros(ctx.rows, grad_out.shape[1], dtype=grad_out.dtype)
        _send_back(grad_out.contiguous().numpy(), ctx.winner, out.numpy())
        return out, None, None


@jit
def _largest(values, segment, out, winner):
    """Write the maxima (S, C) and the first rows that hold them; -1 where a segment has no row."""
    for k in range(len(values)):
        s = segment[k]
        for c in range(values.shape[1]):
            value, best = values[k, c], out[s, c]
            # A NaN replaces any number but infinity, and nothing replaces it.
            if winner[s, c] < 0 or value > best or (np.isnan(value) and best < np.inf):
                out[s, c] = value
                winner[s, c] = k


@jit
def _send_back(grad_out, winner, out):
    """Add each maximum's gradient (S, C) to the row that held it (K, C)."""
    for s in range(len(grad_out)):
        for c in range(grad_out.shape[1]):
            if winner[s, c] >= 0:
                out[winner[s, c], c] += grad_out[s, c]
