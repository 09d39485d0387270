"""Sparse convolution on the CPU: products in register tiles, bits that do not depend on the number of threads.

Outputs are worked on in blocks of rows; in a block the kernel's offsets follow each other, and an offset's input rows
are gathered, multiplied and added in one pass (:mod:`beambox.ops.sparse_conv.tiles`). Every output row thus adds its
neighbours in the order of the offsets. Gradients with respect to the input are the same product along the inverse map;
those of the weights are summed block after block.

In half precision the rows that a stretch of outputs sees are laid side by side and multiplied by PyTorch, which knows
the processor's matrix units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from beambox.ops.jit import jit, parallel_for
from beambox.ops.sparse_conv.autograd import convolve_with
from beambox.ops.sparse_conv.cpu_maps import BLOCK, BlockPairs, block_pairs
from beambox.ops.sparse_conv.sites import KernelMap
from beambox.ops.sparse_conv.tiles import ROWS, VECTOR_BYTES, WIDE, multiply_rows, outer_products

__all__ = ["convolve", "forward", "weight_grad"]

STRETCH = 4
"""Blocks laid side by side at a time in half precision."""

_rows_1, _rows_2, _rows_4 = (multiply_rows[n] for n in (1, 2, 4))
_outer_1, _outer_2, _outer_4 = (outer_products[n] for n in (1, 2, 4))


def convolve(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Gather, multiply and add, as :func:`beambox.ops.sparse_conv.reference.convolve` defines it; differentiable."""
    if features.dtype in (torch.bfloat16, torch.float16):
        return convolve_with(forward_half, weight_grad_half, features, weight, bias, pairs)
    return convolve_with(forward, weight_grad, features, weight, bias, pairs)


def forward(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Compute the convolution without recording gradients: ``(V_in, C_in)`` -> ``(V_out, C_out)``."""
    rows, c_out = len(pairs.target), weight.shape[2]
    blocks = pairs.kept(block_pairs)
    out = features.new_empty((rows + len(blocks.count), c_out + -c_out % _lanes(weight)))
    start = _filled(features.new_zeros(c_out) if bias is None else bias).numpy()
    x, w, y = features.contiguous().numpy(), _filled(weight).contiguous().numpy(), out.numpy()
    source, target, order = blocks.source.reshape(-1), blocks.target.reshape(-1), pairs.target.order.numpy()
    parallel_for(
        lambda first, last: _forward(x, w, start, source, target, order, blocks.count, y, first, last),
        len(blocks.count),
    )
    return out[:rows, :c_out].contiguous()


def weight_grad(features: Tensor, grad: Tensor, pairs: KernelMap) -> Tensor:
    """Compute the gradient of the weights: ``(K, C_in, C_out)``."""
    c_in, c_out = features.shape[1], grad.shape[1]
    blocks = pairs.kept(block_pairs)
    x = functional.pad(features, (0, -c_in % ROWS)).contiguous().numpy()
    g = _filled(grad).contiguous().numpy()
    out = features.new_zeros((pairs.spec.offsets, x.shape[1], g.shape[1]))
    y, source, target = out.numpy(), blocks.source.reshape(-1), blocks.target.reshape(-1)
    parallel_for(lambda first, last: _weight_grad(x, g, source, target, blocks.count, y, first, last), len(out))
    return out[:, :c_in, :c_out].contiguous()


def forward_half(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Compute the convolution in half precision; each output row is one sum over K * C_in products."""
    order = pairs.target.order
    out = features.new_empty((len(order), weight.shape[2]))
    kernel = weight.reshape(-1, weight.shape[2])  # (K * C_in, C_out)
    for start, patches in _im2col(features, pairs):
        product = patches @ kernel if bias is None else torch.addmm(bias, patches, kernel)
        out[order[start : start + len(patches)]] = product
    return out


def weight_grad_half(features: Tensor, grad: Tensor, pairs: KernelMap) -> Tensor:
    """Compute the gradient of the weights in half precision, summed in float32."""
    order = pairs.target.order
    total = features.new_zeros((pairs.spec.offsets * features.shape[1], grad.shape[1]), dtype=torch.float32)
    for start, patches in _im2col(features, pairs):
        total += patches.t() @ grad[order[start : start + len(patches)]]
    return total.reshape(-1, features.shape[1], grad.shape[1]).to(features.dtype)


def _im2col(features: Tensor, pairs: KernelMap) -> Iterator[tuple[int, Tensor]]:
    """Yield, for stretches of outputs in ascending order, the rows each sees: ``(rows, K * C_in)``, zero for none."""
    order, blocks = pairs.target.order, pairs.kept(block_pairs)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    width = blocks.count.shape[1] * features.shape[1]
    x = features.contiguous().view(torch.int16).numpy()
    for first in range(0, len(blocks.count), STRETCH):
        last = min(first + STRETCH, len(blocks.count))
        start = first * BLOCK
        patches = torch.zeros((min(len(order), last * BLOCK) - start, width), dtype=features.dtype)
        y = patches.view(torch.int16).numpy()
        if len(features):
            parallel_for(_im2col_blocks(x, blocks, place.numpy(), y, first, start), last - first)
        yield start, patches


def _im2col_blocks(
    x: np.ndarray, blocks: BlockPairs, place: np.ndarray, y: np.ndarray, first: int, start: int
) -> Callable[[int, int], None]:
    return lambda a, b: _im2col_block(
        x, blocks.source, blocks.target, blocks.count, place, y, start, first + a, first + b
    )


def _lanes(values: Tensor) -> int:
    return VECTOR_BYTES // values.element_size()


def _filled(values: Tensor) -> Tensor:
    """Fill the last dimension with zeros up to a whole number of vectors."""
    return functional.pad(values, (0, -values.shape[-1] % _lanes(values)))


@jit
def _forward(x, weight, start, source, target, order, count, out, first_block, last_block):
    """Fill a block's rows with ``start``, and the row that its incomplete tiles write to; then add the products."""
    offsets = weight.shape[0]
    lanes = VECTOR_BYTES // x.itemsize
    vectors = weight.shape[2] // lanes
    for block in range(first_block, last_block):
        for i in range(block * BLOCK, min(len(order), (block + 1) * BLOCK)):
            out[order[i]] = start
        out[len(order) + block] = start
        for k in range(offsets):
            begin = (block * offsets + k) * BLOCK
            stop = begin + count[block, k]
            v = 0
            while v < vectors:
                left = vectors - v
                if WIDE >= 4 and left >= 4:
                    for first in range(begin, stop, ROWS):
                        _rows_4(x, weight, out, source, target, first, k, v * lanes)
                    v += 4
                elif left >= 2:
                    for first in range(begin, stop, ROWS):
                        _rows_2(x, weight, out, source, target, first, k, v * lanes)
                    v += 2
                else:
                    for first in range(begin, stop, ROWS):
                        _rows_1(x, weight, out, source, target, first, k, v * lanes)
                    v += 1


@jit
def _weight_grad(x, grad, source, target, count, out, first_offset, last_offset):
    lanes = VECTOR_BYTES // x.itemsize
    vectors = grad.shape[1] // lanes
    if count.size == 0:
        return
    block_rows = len(source) // count.size
    for k in range(first_offset, last_offset):
        for block in range(count.shape[0]):
            first, pairs = (block * out.shape[0] + k) * block_rows, count[block, k]
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


@jit
def _im2col_block(x, source, target, count, place, patches, start, first_block, last_block):
    channels = x.shape[1]
    for block in range(first_block, last_block):
        for k in range(count.shape[1]):
            for pair in range(count[block, k]):
                row, at = source[block, k, pair], place[target[block, k, pair]] - start
                for c in range(channels):
                    patches[at, k * channels + c] = x[row, c]
