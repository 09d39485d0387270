"""Neighbourhood attention row by row, without copies of K and V, and its gradients (numba).

Only the weights, window x window a pixel, are kept for the gradient. Every output element is written by one block alone
and added up in one order, so nothing depends on the number of threads: the gradients of k and v are gathered from the
queries that saw a pixel, not scattered by them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beambox.ops.dispatch import needs_gradient
from beambox.ops.jit import jit, jit_fastmath, parallel_for
from beambox.ops.neighborhood.windows import queries_of, window_start

__all__ = ["neighborhood_attention"]


def neighborhood_attention(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int = 7) -> Tensor:
    """Attend to the window around each pixel; see :func:`beambox.ops.neighborhood.neighborhood_attention`."""
    return _Attention.apply(q, k, v, bias, window, needs_gradient(q, k, v, bias))


class _Attention(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int, keep_weights: bool) -> Tensor:
        q, k, v, bias = (tensor.detach().contiguous() for tensor in (q, k, v, bias))
        out = torch.empty_like(q)
        weights = q.new_empty(*q.shape[:4] if keep_weights else (0, 0, 0, 0), window * window)
        rows, columns = (window_start(length, window).numpy() for length in q.shape[2:4])

        def attend(first: int, last: int) -> None:
            arrays = (_flat(tensor) for tensor in (q, k, v))
            _attend(*arrays, bias.numpy(), rows, columns, window, first, last, _flat(weights), _flat(out))

        parallel_for(attend, _rows(q))
        ctx.save_for_backward(q, k, v, bias, weights)
        ctx.window = window
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None, None]:
        q, k, v, bias, weights = ctx.saved_tensors
        window, grad_out = ctx.window, grad_out.contiguous()
        dq, dk, dv, grad_logits = (torch.empty_like(tensor) for tensor in (q, k, v, weights))
        by_row = q.new_zeros(_rows(q), *bias.shape[1:]).numpy()  # the bias's gradient, before it is added over rows
        rows, columns = (queries_of(length, window).numpy() for length in q.shape[2:4])

        def to_queries(first: int, last: int) -> None:
            arrays = (_flat(tensor) for tensor in (k, v, weights, grad_out, dq, grad_logits))
            _to_queries(*arrays, by_row, rows, columns, window, first, last)

        def to_keys(first: int, last: int) -> None:
            arrays = (_flat(tensor) for tensor in (q, weights, grad_out, grad_logits, dk, dv))
            _to_keys(*arrays, rows, columns, window, first, last)

        parallel_for(to_queries, _rows(q))
        parallel_for(to_keys, _rows(q))
        dbias = torch.zeros_like(bias)
        _add_rows(by_row, q.shape[2], dbias.numpy())
        return dq, dk, dv, dbias, None, None


def _rows(q: Tensor) -> int:
    return q.shape[0] * q.shape[1] * q.shape[2]


def _flat(tensor: Tensor) -> np.ndarray:
    """Return ``(B, heads, H, W, X)`` as an array ``(B * heads, H, W, X)``."""
    return tensor.flatten(0, 1).numpy()


@jit_fastmath
def _attend(q, k, v, bias, rows, columns, window, first, last, weights, out):
    """Attend for the pixels of rows ``first`` to ``last``, counted over all maps; keep weights if there is room."""
    height, width, depth = q.shape[1], q.shape[2], q.shape[3]
    scale = q.dtype.type(1 / np.sqrt(depth))
    weight = np.empty(window * window, q.dtype)
    for place in range(first, last):
        image, i = place // height, place % height
        table = bias[image % len(bias)]
        top = rows[i]
        for j in range(width):
            left = columns[j]
            largest = q.dtype.type(-np.inf)
            for r in range(window):
                for c in range(window):
                    dot = q.dtype.type(0)
                    for x in range(depth):
                        dot += q[image, i, j, x] * k[image, top + r, left + c, x]
                    logit = dot * scale + table[top + r - i + window - 1, left + c - j + window - 1]
                    weight[r * window + c] = logit
                    largest = max(largest, logit)
            total = q.dtype.type(0)
            for n in range(window * window):
                weight[n] = np.exp(weight[n] - largest)
                total += weight[n]
            for x in range(depth):
                out[image, i, j, x] = 0
            for r in range(window):
                for c in range(window):
                    share = weight[r * window + c] / total
                    weight[r * window + c] = share
                    for x in range(depth):
                        out[image, i, j, x] += share * v[image, top + r, left + c, x]
            if len(weights):
                weights[image, i, j] = weight


@jit_fastmath
def _to_queries(k, v, weights, grad_out, dq, grad_logits, by_row, rows, columns, window, first, last):
    """Write the gradients of q and of the logits (``grad_logits``), and add those of the bias up over each row."""
    height, width, depth = k.shape[1], k.shape[2], k.shape[3]
    scale = k.dtype.type(1 / np.sqrt(depth))
    for place in range(first, last):
        image, i = place // height, place % height
        top = rows[0, i]
        for j in range(width):
            left = columns[0, j]
            mean = k.dtype.type(0)
            for r in range(window):
                for c in range(window):
                    n = r * window + c
                    dot = k.dtype.type(0)
                    for x in range(depth):
                        dot += grad_out[image, i, j, x] * v[image, top + r, left + c, x]
                    grad_logits[image, i, j, n] = dot
                    mean += weights[image, i, j, n] * dot
            for x in range(depth):
                dq[image, i, j, x] = 0
            for r in range(window):
                for c in range(window):
                    n = r * window + c
                    grad_logit = weights[image, i, j, n] * (grad_logits[image, i, j, n] - mean)
                    grad_logits[image, i, j, n] = grad_logit
                    by_row[place, top + r - i + window - 1, left + c - j + window - 1] += grad_logit
                    for x in range(depth):
                        dq[image, i, j, x] += grad_logit * scale * k[image, top + r, left + c, x]


@jit_fastmath
def _to_keys(q, weights, grad_out, grad_logits, dk, dv, rows, columns, window, first, last):
    """Write the gradients of k and v: each pixel gathers from the queries whose window holds it."""
    height, width, depth = q.shape[1], q.shape[2], q.shape[3]
    scale = q.dtype.type(1 / np.sqrt(depth))
    for place in range(first, last):
        image, row = place // height, place % height
        for column in range(width):
            for x in range(depth):
                dk[image, row, column, x] = 0
                dv[image, row, column, x] = 0
            for i in range(rows[1, row], rows[2, row]):
                for j in range(columns[1, column], columns[2, column]):
                    n = (row - rows[0, i]) * window + column - columns[0, j]
                    share, grad_logit = weights[image, i, j, n], grad_logits[image, i, j, n] * scale
                    for x in range(depth):
                        dk[image, row, column, x] += grad_logit * q[image, i, j, x]
                        dv[image, row, column, x] += share * grad_out[image, i, j, x]


@jit
def _add_rows(by_row, height, dbias):
    """Add the rows of all images of each head, in order."""
    for place in range(len(by_row)):
        dbias[place // height % len(dbias)] += by_row[place]
