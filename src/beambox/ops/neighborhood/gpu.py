"""Neighbourhood attention and its gradients on a GPU (Triton), without copies of K and V and without atomics.

Forward, each program takes a stretch of one row and walks through the window with a running softmax; only the logarithm
of its denominator is kept. Backward, the weights are computed again; the gradients of k and v are gathered from the
queries that saw a pixel.
"""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from beambox.ops.neighborhood.windows import queries_of, window_start

__all__ = ["neighborhood_attention"]

BLOCK = 32  # pixels a program


def neighborhood_attention(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int = 7) -> Tensor:
    """Attend to the window around each pixel; see :func:`beambox.ops.neighborhood.neighborhood_attention`."""
    return _Attention.apply(q / q.shape[4] ** 0.5, k, v, bias, window)


class _Attention(torch.autograd.Function):
    """Takes queries that are already divided by sqrt(d)."""

    @staticmethod
    def forward(ctx: Any, q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int) -> Tensor:
        q, k, v, bias = (tensor.detach().contiguous() for tensor in (q, k, v, bias))
        out = torch.empty_like(q)
        wide = torch.float64 if q.dtype == torch.float64 else torch.float32
        log_total = torch.empty(q.shape[:4], dtype=wide, device=q.device)
        if q.numel():
            _attend[_grid(q)](q, k, v, bias, out, log_total, *_sizes(q, window))
        ctx.save_for_backward(q, k, v, bias, out, log_total)
        ctx.window = window
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        q, k, v, bias, out, log_total = ctx.saved_tensors
        window, grad_out = ctx.window, grad_out.contiguous()
        dq, dk, dv = (torch.empty_like(tensor) for tensor in (q, k, v))
        mean = (grad_out.to(log_total.dtype) * out).sum(dim=4)  # (B, heads, H, W) of the weights' gradients
        weights = log_total.new_zeros(*q.shape[:4], window, window)
        grad_logits = torch.zeros_like(weights)  # the logits' gradients
        if q.numel():
            sizes = _sizes(q, window)
            _to_queries[_grid(q)](q, k, v, bias, log_total, mean, grad_out, weights, grad_logits, dq, *sizes)
            row_low, row_high = queries_of(q.shape[2], window, q.device)[1:].contiguous()
            _to_keys[_grid(q)](q, weights, grad_logits, grad_out, dk, dv, row_low, row_high, *sizes)
        return dq, dk, dv, _bias_gradient(grad_logits, window).to(bias.dtype), None


def _grid(q: Tensor) -> tuple[int, int]:
    batch, heads, height, width, _ = q.shape
    return batch * heads * height, triton.cdiv(width, BLOCK)


def _sizes(q: Tensor, window: int) -> tuple[int, int, int, int, int, int, int]:
    _, heads, height, width, depth = q.shape
    return heads, height, width, depth, window, BLOCK, triton.next_power_of_2(depth)


def _bias_gradient(grad_logits: Tensor, window: int) -> Tensor:
    """Add ``(B, heads, H, W, L, L)`` up by offset from query to neighbour: ``(heads, 2 L - 1, 2 L - 1)``.

    As products with tables of zeros and ones, which add in a fixed order, as atomics would not.
    """

    def offsets(length: int) -> Tensor:  # (length, L, 2 L - 1): 1 where neighbour n of a pixel has that offset
        pixel = torch.arange(length, device=grad_logits.device)[:, None]
        neighbor = window_start(length, window, grad_logits.device)[:, None] + torch.arange(
            window, device=grad_logits.device
        )
        return torch.nn.functional.one_hot(neighbor - pixel + window - 1, 2 * window - 1).to(grad_logits.dtype)

    by_row = torch.einsum("bhijrc,irp->bhjcp", grad_logits, offsets(grad_logits.shape[2]))
    return torch.einsum("bhjcp,jcs->hps", by_row, offsets(grad_logits.shape[3]))


@triton.jit
def _start(position, length, window: tl.constexpr):
    """Return where the window of a row or column starts."""
    return tl.minimum(tl.maximum(position - window // 2, 0), length - window)


@triton.jit
def _attend(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    q, k, v, bias, out, log_total, heads, height, width, depth,
    window: tl.constexpr, block: tl.constexpr, deep: tl.constexpr,
):  # fmt: skip
    """Attend for one stretch of one row."""
    place = tl.program_id(0).to(tl.int64)
    image, i = place // height, place % height
    j = tl.program_id(1) * block + tl.arange(0, block)
    x = tl.arange(0, deep)[None, :]
    has, real = j < width, (j < width)[:, None] & (x < depth)
    top, left = _start(i, height, window), _start(j, width, window)
    table = bias + image % heads * (2 * window - 1) * (2 * window - 1)

    here = (place * width + j)[:, None] * depth + x
    kept = log_total.dtype.element_ty
    query = tl.load(q + here, real, 0.0).to(kept)
    largest = tl.full((block,), float("-inf"), kept)
    total = tl.zeros((block,), kept)
    mixed = tl.zeros((block, deep), kept)
    for r in range(window):
        for c in range(window):
            near = ((image * height + top + r) * width + left + c)[:, None] * depth + x
            offset = (top + r - i + window - 1) * (2 * window - 1) + left + c - j + window - 1
            logit = tl.sum(query * tl.load(k + near, real, 0.0).to(kept), axis=1)
            logit += tl.load(table + offset, has, 0.0).to(kept)
            above = tl.maximum(largest, logit)
            fade, share = tl.exp(largest - above), tl.exp(logit - above)
            mixed = mixed * fade[:, None] + share[:, None] * tl.load(v + near, real, 0.0).to(kept)
            total = total * fade + share
            largest = above
    tl.store(out + here, mixed / total[:, None], real)
    tl.store(log_total + place * width + j, largest + tl.log(total), has)


@triton.jit
def _to_queries(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    q, k, v, bias, log_total, mean, grad_out, weights, grad_logits, dq, heads, height, width, depth,
    window: tl.constexpr, block: tl.constexpr, deep: tl.constexpr,
):  # fmt: skip
    """Write the weights again, the gradients of the logits (``grad_logits``) and of q for one stretch of one row."""
    place = tl.program_id(0).to(tl.int64)
    image, i = place // height, place % height
    j = tl.program_id(1) * block + tl.arange(0, block)
    x = tl.arange(0, deep)[None, :]
    has, real = j < width, (j < width)[:, None] & (x < depth)
    top, left = _start(i, height, window), _start(j, width, window)
    table = bias + image % heads * (2 * window - 1) * (2 * window - 1)

    here = (place * width + j)[:, None] * depth + x
    kept = log_total.dtype.element_ty
    query = tl.load(q + here, real, 0.0).to(kept)
    grad = tl.load(grad_out + here, real, 0.0).to(kept)
    log_sum = tl.load(log_total + place * width + j, has, 0.0)
    average = tl.load(mean + place * width + j, has, 0.0)
    total = tl.zeros((block, deep), kept)
    for r in range(window):
        for c in range(window):
            near = ((image * height + top + r) * width + left + c)[:, None] * depth + x
            offset = (top + r - i + window - 1) * (2 * window - 1) + left + c - j + window - 1
            key = tl.load(k + near, real, 0.0).to(kept)
            logit = tl.sum(query * key, axis=1) + tl.load(table + offset, has, 0.0).to(kept)
            weight = tl.exp(logit - log_sum)
            grad_logit = weight * (tl.sum(grad * tl.load(v + near, real, 0.0).to(kept), axis=1) - average)
            total += grad_logit[:, None] * key
            cell = (place * width + j) * window * window + r * window + c
            tl.store(weights + cell, weight, has)
            tl.store(grad_logits + cell, grad_logit, has)
    tl.store(dq + here, total, real)


@triton.jit
def _to_keys(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    q, weights, grad_logits, grad_out, dk, dv, row_low, row_high, heads, height, width, depth,
    window: tl.constexpr, block: tl.constexpr, deep: tl.constexpr,
):  # fmt: skip
    """Gather the gradients of k and v for one stretch of one row, from the queries whose window holds each pixel."""
    place = tl.program_id(0).to(tl.int64)
    image, row = place // height, place % height
    column = tl.program_id(1) * block + tl.arange(0, block)
    x = tl.arange(0, deep)[None, :]
    real = (column < width)[:, None] & (x < depth)
    kept = weights.dtype.element_ty
    to_key = tl.zeros((block, deep), kept)
    to_value = tl.zeros((block, deep), kept)
    i, end = tl.load(row_low + row), tl.load(row_high + row)
    while i < end:
        for step in range(2 * window - 1):
            j = column + step - window + 1
            beside = column - _start(j, width, window)
            sees = (column < width) & (j >= 0) & (j < width) & (beside >= 0) & (beside < window)
            query = (image * height + i) * width + j
            cell = query * window * window + (row - _start(i, height, window)) * window + beside
            share, grad_logit = tl.load(weights + cell, sees, 0.0), tl.load(grad_logits + cell, sees, 0.0)
            there, mask = query[:, None] * depth + x, sees[:, None] & (x < depth)
            to_key += grad_logit[:, None] * tl.load(q + there, mask, 0.0).to(kept)
            to_value += share[:, None] * tl.load(grad_out + there, mask, 0.0).to(kept)
        i += 1
    here = (place * width + column)[:, None] * depth + x
    tl.store(dk + here, to_key, real)
    tl.store(dv + here, to_value, real)
