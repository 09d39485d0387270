"""Reductions over groups of rows on a GPU (Triton): one program a segment, no atomics, the same sum every time."""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["segment_max", "segment_mean", "segment_sum"]


def segment_sum(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Add the rows of each segment; see :func:`beambox.ops.scatter.segment_sum`."""
    return _SegmentSum.apply(values, segment, size)


def segment_mean(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Average the rows of each segment; see :func:`beambox.ops.scatter.segment_mean`."""
    by_segment = segment.sort().values
    edges = torch.searchsorted(by_segment, torch.arange(size + 1, device=segment.device))  # (S + 1,)
    count = (edges[1:] - edges[:-1]).clamp(min=1).to(values.dtype)  # bincount would make the host wait
    return segment_sum(values, segment, size) / count[:, None]


def segment_max(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Take the largest of each segment and column; see :func:`beambox.ops.scatter.segment_max`."""
    return _SegmentMax.apply(values, segment, size)


class _SegmentSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, segment: Tensor, size: int) -> Tensor:
        ctx.save_for_backward(segment)
        return _reduce(values, segment, size, largest=False)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, None, None]:
        (segment,) = ctx.saved_tensors
        return grad_out[segment], None, None


class _SegmentMax(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, segment: Tensor, size: int) -> Tensor:
        out, winner = _reduce(values, segment, size, largest=True)
        ctx.save_for_backward(winner)
        ctx.rows = len(values)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, None, None]:
        (winner,) = ctx.saved_tensors
        out = grad_out.new_zeros(ctx.rows + 1, grad_out.shape[1])  # the last row takes what empty segments send
        return out.scatter(0, winner, grad_out)[:-1], None, None


def _reduce(values: Tensor, segment: Tensor, size: int, largest: bool) -> tuple[Tensor, Tensor]:
    """Return the sums or maxima ``(S, C)`` and, for maxima, the rows that held them (K where a segment is empty)."""
    values = values.contiguous()
    rows, columns = values.shape
    out = values.new_zeros(size, columns)
    winner = torch.full((size, columns) if largest else (0,), rows, dtype=torch.int64, device=values.device)
    if out.numel() and rows:
        by_segment, order = segment.sort(stable=True)
        edges = torch.arange(size + 1, device=segment.device)
        start = torch.searchsorted(by_segment, edges)  # (S + 1,)
        block = min(128, triton.next_power_of_2(columns))
        wide = tl.float64 if values.dtype == torch.float64 else tl.float32
        grid = (size, triton.cdiv(columns, block))
        _reduce_segment[grid](values, order, start, out, winner, rows, columns, largest, wide, block)
    return out, winner


@triton.jit
def _reduce_segment(
    values, order, start, out, winner, rows, columns, largest: tl.constexpr, wide: tl.constexpr, block: tl.constexpr
):
    """Reduce one segment's rows, in scan order, for one block of columns."""
    segment = tl.program_id(0)
    column = tl.program_id(1) * block + tl.arange(0, block)
    total = tl.zeros((block,), wide)
    first = tl.zeros((block,), tl.int64) + rows
    at, end = tl.load(start + segment), tl.load(start + segment + 1)
    while at < end:
        row = tl.load(order + at)
        value = tl.load(values + row * columns + column, column < columns, 0.0).to(wide)
        if largest:
            # A NaN replaces any number but infinity, and nothing replaces it.
            better = (first == rows) | (value > total) | ((value != value) & (total < float("inf")))  # noqa: PLR0124
            total = tl.where(better, value, total)
            first = tl.where(better, row, first)
        else:
            total += value
        at += 1
    place = segment.to(tl.int64) * columns + column
    tl.store(out + place, total, column < columns)
    if largest:
        tl.store(winner + place, first, column < columns)
