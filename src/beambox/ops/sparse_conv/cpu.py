"""Sparse convolution on the CPU: maps by merging sorted keys, products in register tiles, bits fixed.

Outputs are worked on in blocks of :data:`BLOCK` rows, one thread a block; in a block the offsets follow each other, and
an offset's rows are gathered, multiplied and added in one pass (:mod:`beambox.ops.sparse_conv.tiles`). Every output row
thus adds its neighbours in the order of the offsets, whatever the number of threads. Gradients with respect to the
input are the same product along the inverse map; those of the weights are summed block after block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from beambox.ops.sparse_conv.sites import Geometry, KernelMap, Sites
from beambox.ops.sparse_conv.tiles import ROWS, VECTOR_BYTES, WIDE, multiply_rows, outer_products

__all__ = ["BlockPairs", "convolve", "find_targets", "group_pairs", "neighbour_table"]

BLOCK = 256
"""Output rows of one block: their sums stay in the second-level cache."""
CHUNK = 1024
"""Sites of one task when maps are built."""

_rows_1, _rows_2, _rows_4 = (multiply_rows[n] for n in (1, 2, 4))
_outer_1, _outer_2, _outer_4 = (outer_products[n] for n in (1, 2, 4))


@dataclass(frozen=True)
class BlockPairs:
    """The pairs of a kernel map, grouped by block of output rows and then by kernel offset."""

    start: np.ndarray
    """``(blocks * K + 1,)`` int64 first pair of each group, a multiple of ``ROWS``."""
    count: np.ndarray
    """``(blocks * K,)`` int64 pairs of each group; the rest up to the next group is filling."""
    source: np.ndarray
    """``(P,)`` int32 input row; 0 in the filling."""
    target: np.ndarray
    """``(P,)`` int32 output row; in the filling a row of its own behind the last, one a block."""
    blocks: int
    """Number of blocks."""


# --- maps -----------------------------------------------------------------------------------------------------------


def find_targets(source: Sites, geometry: Geometry) -> Tensor:
    """Return the ascending keys of every output whose receptive field holds an active input."""
    if len(source) == 0:
        return source.sorted_keys
    keys = source.sorted_keys.numpy()
    shape, out_shape = np.array(source.shape), np.array(geometry.output_shape(source.shape))
    found = _reached(
        keys,
        shape,
        out_shape,
        np.array(geometry.kernel),
        np.array(geometry.stride),
        np.array(geometry.padding),
        np.array(geometry.dilation),
    )
    found.sort()
    first = np.ones(len(found), dtype=bool)
    first[1:] = found[1:] != found[:-1]
    return torch.from_numpy(found[first])


@numba.njit(cache=True, nogil=True)
def _reached(keys, shape, out_shape, kernel, stride, padding, dilation):
    """List the outputs that each input reaches, leaving out what the input before reached through the same offset."""
    out = np.empty(max(64, 4 * len(keys)), np.int64)
    n = 0
    last = np.full((kernel[0], kernel[1]), -1, np.int64)
    for key in keys:
        x = key % shape[2]
        rest = key // shape[2]
        y = rest % shape[1]
        rest //= shape[1]
        z = rest % shape[0]
        b = rest // shape[0]
        for kz in range(kernel[0]):
            oz = z + padding[0] - kz * dilation[0]
            if oz < 0 or oz % stride[0] or oz // stride[0] >= out_shape[0]:
                continue
            for ky in range(kernel[1]):
                oy = y + padding[1] - ky * dilation[1]
                if oy < 0 or oy % stride[1] or oy // stride[1] >= out_shape[1]:
                    continue
                line = ((b * out_shape[0] + oz // stride[0]) * out_shape[1] + oy // stride[1]) * out_shape[2]
                for kx in range(kernel[2] - 1, -1, -1):  # so that x ascends
                    ox = x + padding[2] - kx * dilation[2]
                    if ox < 0 or ox % stride[2] or ox // stride[2] >= out_shape[2]:
                        continue
                    reached = line + ox // stride[2]
                    if reached <= last[kz, ky] and dilation[2] == 1:
                        continue  # without gaps between its columns an offset's outputs ascend
                    last[kz, ky] = reached
                    if n == len(out):
                        grown = np.empty(2 * n, np.int64)
                        grown[:n] = out
                        out = grown
                    out[n] = reached
                    n += 1
    return out[:n].copy()


def neighbour_table(source: Sites, target: Sites, geometry: Geometry) -> Tensor:
    """Find the input row that reaches each output through each kernel offset: ``(V_out, K)`` int32, -1 for none."""
    table = np.empty((len(target), geometry.offsets), np.int32)
    _merge(
        source.sorted_keys.numpy(),
        source.order.numpy(),
        target.sorted_keys.numpy(),
        target.order.numpy(),
        np.array(source.shape),
        np.array(target.shape),
        np.array(geometry.kernel),
        np.array(geometry.stride),
        np.array(geometry.padding),
        np.array(geometry.dilation),
        table,
    )
    return torch.from_numpy(table)


@numba.njit(cache=True, nogil=True, parallel=True)
def _merge(
    keys,
    order,
    out_keys,
    out_order,
    shape,
    out_shape,
    kernel,
    stride,
    padding,
    dilation,
    table,
):
    """Walk the outputs in order and, for each row of the kernel, one pointer along the sorted inputs."""
    size = len(keys)
    lines = kernel[0] * kernel[1]
    for chunk in numba.prange((len(out_keys) + CHUNK - 1) // CHUNK):
        pointer = np.full(lines, -1, np.int64)
        for i in range(chunk * CHUNK, min(len(out_keys), (chunk + 1) * CHUNK)):
            row = table[out_order[i]]
            row[:] = -1
            x0 = (out_keys[i] % out_shape[2]) * stride[2] - padding[2]
            rest = out_keys[i] // out_shape[2]
            y0 = (rest % out_shape[1]) * stride[1] - padding[1]
            rest //= out_shape[1]
            z0 = (rest % out_shape[0]) * stride[0] - padding[0]
            b = rest // out_shape[0]
            for kz in range(kernel[0]):
                z = z0 + kz * dilation[0]
                if z < 0 or z >= shape[0]:
                    continue
                for ky in range(kernel[1]):
                    y = y0 + ky * dilation[1]
                    if y < 0 or y >= shape[1]:
                        continue
                    line = kz * kernel[1] + ky
                    start = ((b * shape[0] + z) * shape[1] + y) * shape[2]
                    at = pointer[line]
                    if at < 0:
                        at = np.searchsorted(keys, start + max(x0, 0))
                    else:
                        while at < size and keys[at] < start + max(x0, 0):
                            at += 1
                    pointer[line] = at
                    for kx in range(kernel[2]):
                        x = x0 + kx * dilation[2]
                        if x < 0 or x >= shape[2]:
                            continue
                        while at < size and keys[at] < start + x:
                            at += 1
                        if at < size and keys[at] == start + x:
                            row[line * kernel[2] + kx] = order[at]


def group_pairs(table: Tensor) -> BlockPairs:
    """Group the pairs of a ``(V_out, K)`` table."""
    rows, offsets = table.shape
    blocks = -(-rows // BLOCK)
    count = np.zeros(blocks * offsets, np.int64)
    _count(table.numpy(), count)
    start = np.zeros(blocks * offsets + 1, np.int64)
    np.cumsum(-(-count // ROWS) * ROWS, out=start[1:])
    source, target = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    _group(table.numpy(), start, source, target)
    return BlockPairs(start, count, source, target, blocks)


@numba.njit(cache=True, nogil=True, parallel=True)
def _count(table, count):
    rows, offsets = table.shape
    for block in numba.prange((rows + BLOCK - 1) // BLOCK):
        for row in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            for k in range(offsets):
                count[block * offsets + k] += table[row, k] >= 0


@numba.njit(cache=True, nogil=True, parallel=True)
def _group(table, start, source, target):
    rows, offsets = table.shape
    for block in numba.prange((rows + BLOCK - 1) // BLOCK):
        place = start[block * offsets : (block + 1) * offsets].copy()
        for row in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            for k in range(offsets):
                if table[row, k] >= 0:
                    source[place[k]] = table[row, k]
                    target[place[k]] = row
                    place[k] += 1
        for k in range(offsets):
            for p in range(place[k], start[block * offsets + k + 1]):
                source[p] = 0
                target[p] = rows + block


# --- products -------------------------------------------------------------------------------------------------------


def convolve(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Gather, multiply and add, as :func:`beambox.ops.sparse_conv.reference.convolve` defines it; differentiable."""
    return _Convolution.apply(features, weight, bias, pairs)


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, features, weight, bias, pairs):
        ctx.save_for_backward(features, weight)
        ctx.pairs = pairs
        return multiply(features, weight, bias, pairs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        features, weight = ctx.saved_tensors
        of_features = of_weight = of_bias = None
        if ctx.needs_input_grad[0]:
            of_features = multiply(grad, weight.transpose(1, 2), None, ctx.pairs.inverse)
        if ctx.needs_input_grad[1]:
            of_weight = accumulate(features, grad, ctx.pairs)
        if ctx.needs_input_grad[2]:
            of_bias = grad.t().contiguous().sum(dim=1)  # one thread a channel
        return of_features, of_weight, of_bias, None


def multiply(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Compute the convolution without recording gradients: ``(V_in, C_in)`` -> ``(V_out, C_out)``."""
    rows, c_out = len(pairs.target), weight.shape[2]
    blocks = pairs.blocks
    padded = _lanes(weight.detach(), weight.dtype).contiguous()  # (K, C_in, W)
    out = features.new_empty((rows + blocks.blocks, padded.shape[2]))
    if bias is None:
        out.zero_()
    else:
        out.copy_(_lanes(bias.detach(), bias.dtype).expand_as(out))
    if len(features):
        source = features.detach().contiguous().numpy()
        _multiply(source, padded.numpy(), blocks.start, blocks.source, blocks.target, out.numpy())
    return out[:rows, :c_out].contiguous()


def accumulate(features: Tensor, grad: Tensor, pairs: KernelMap) -> Tensor:
    """Compute the gradient of the weights: ``(K, C_in, C_out)``."""
    c_in, c_out = features.shape[1], grad.shape[1]
    blocks = pairs.blocks
    x = functional.pad(features.detach(), (0, -c_in % ROWS)).contiguous()
    g = _lanes(grad.detach(), grad.dtype).contiguous()
    out = features.new_zeros((pairs.table.shape[1], x.shape[1], g.shape[1]))
    _accumulate(x.numpy(), g.numpy(), blocks.start, blocks.count, blocks.source, blocks.target, out.numpy())
    return out[:, :c_in, :c_out].contiguous()


def _lanes(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Fill the last dimension with zeros up to a whole number of vectors."""
    return functional.pad(values, (0, -values.shape[-1] % (VECTOR_BYTES // dtype.itemsize)))


@numba.njit(cache=True, nogil=True, parallel=True)
def _multiply(x, weight, start, source, target, out):
    offsets = weight.shape[0]
    lanes = VECTOR_BYTES // x.itemsize
    vectors = weight.shape[2] // lanes
    for block in numba.prange((len(start) - 1) // offsets):
        for k in range(offsets):
            group = block * offsets + k
            v = 0
            while v < vectors:
                left = vectors - v
                if WIDE >= 4 and left >= 4:
                    for first in range(start[group], start[group + 1], ROWS):
                        _rows_4(x, weight, out, source, target, first, k, v * lanes)
                    v += 4
                elif left >= 2:
                    for first in range(start[group], start[group + 1], ROWS):
                        _rows_2(x, weight, out, source, target, first, k, v * lanes)
                    v += 2
                else:
                    for first in range(start[group], start[group + 1], ROWS):
                        _rows_1(x, weight, out, source, target, first, k, v * lanes)
                    v += 1


@numba.njit(cache=True, nogil=True, parallel=True)
def _accumulate(x, grad, start, count, source, target, out):
    offsets = out.shape[0]
    lanes = VECTOR_BYTES // x.itemsize
    vectors = grad.shape[1] // lanes
    for k in numba.prange(offsets):
        for block in range(len(count) // offsets):
            first, pairs = start[block * offsets + k], count[block * offsets + k]
            if pairs == 0:
                continue
            for channel in range(0, x.shape[1], ROWS):
                v = 0
                while v < vectors:
                    left = vectors - v
                    if WIDE >= 4 and left >= 4:
                        _outer_4(x, grad, out, source, target, first, pairs, k, channel, v * lanes)
                        v += 4
                    elif left >= 2:
                        _outer_2(x, grad, out, source, target, first, pairs, k, channel, v * lanes)
                        v += 2
                    else:
                        _outer_1(x, grad, out, source, target, first, pairs, k, channel, v * lanes)
                        v += 1
