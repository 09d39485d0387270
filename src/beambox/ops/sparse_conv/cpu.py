"""Sparse convolution on the CPU: products in register tiles, bits that do not depend on the number of threads.

Outputs are worked on in blocks of rows; in a block the kernel's offsets follow each other, and an offset's input rows
are gathered, multiplied and added in one pass (:mod:`beambox.ops.sparse_conv.tiles`). Every output row thus adds its
neighbours in the order of the offsets. Gradients with respect to the input are the same product along the inverse map;
those of the weights are summed block after block.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from beambox.ops.jit import jit, run_in_blocks
from beambox.ops.sparse_conv.sites import KernelMap
from beambox.ops.sparse_conv.tiles import ROWS, VECTOR_BYTES, WIDE, multiply_rows, outer_products

__all__ = ["accumulate", "convolve", "multiply"]

_rows_1, _rows_2, _rows_4 = (multiply_rows[n] for n in (1, 2, 4))
_outer_1, _outer_2, _outer_4 = (outer_products[n] for n in (1, 2, 4))


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
    out = features.new_empty((rows + len(blocks.count), c_out + -c_out % _lanes(weight)))
    if bias is None:
        out.zero_()
    else:
        out.copy_(_filled(bias.detach()).expand_as(out))
    if len(features):
        x, w, y = features.detach().contiguous().numpy(), _filled(weight.detach()).contiguous().numpy(), out.numpy()
        source, target = blocks.source.reshape(-1), blocks.target.reshape(-1)
        run_in_blocks(
            lambda first, last: _multiply(x, w, source, target, blocks.count, y, first, last), len(blocks.count)
        )
    return out[:rows, :c_out].contiguous()


def accumulate(features: Tensor, grad: Tensor, pairs: KernelMap) -> Tensor:
    """Compute the gradient of the weights: ``(K, C_in, C_out)``."""
    c_in, c_out = features.shape[1], grad.shape[1]
    blocks = pairs.blocks
    x = functional.pad(features.detach(), (0, -c_in % ROWS)).contiguous().numpy()
    g = _filled(grad.detach()).contiguous().numpy()
    out = features.new_zeros((pairs.geometry.offsets, x.shape[1], g.shape[1]))
    y, source, target = out.numpy(), blocks.source.reshape(-1), blocks.target.reshape(-1)
    run_in_blocks(lambda first, last: _accumulate(x, g, source, target, blocks.count, y, first, last), len(out))
    return out[:, :c_in, :c_out].contiguous()


def _lanes(values: Tensor) -> int:
    return VECTOR_BYTES // values.element_size()


def _filled(values: Tensor) -> Tensor:
    """Fill the last dimension with zeros up to a whole number of vectors."""
    return functional.pad(values, (0, -values.shape[-1] % _lanes(values)))


@jit
def _multiply(x, weight, source, target, count, out, first_block, last_block):
    offsets = weight.shape[0]
    lanes = VECTOR_BYTES // x.itemsize
    vectors = weight.shape[2] // lanes
    block_rows = len(source) // count.size
    for block in range(first_block, last_block):
        for k in range(offsets):
            start = (block * offsets + k) * block_rows
            stop = start + count[block, k]
            v = 0
            while v < vectors:
                left = vectors - v
                if WIDE >= 4 and left >= 4:
                    for first in range(start, stop, ROWS):
                        _rows_4(x, weight, out, source, target, first, k, v * lanes)
                    v += 4
                elif left >= 2:
                    for first in range(start, stop, ROWS):
                        _rows_2(x, weight, out, source, target, first, k, v * lanes)
                    v += 2
                else:
                    for first in range(start, stop, ROWS):
                        _rows_1(x, weight, out, source, target, first, k, v * lanes)
                    v += 1


@jit
def _accumulate(x, grad, source, target, count, out, first_offset, last_offset):
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
