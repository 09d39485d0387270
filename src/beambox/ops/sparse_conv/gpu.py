"""Sparse convolution on a GPU (Triton): one implicit matrix product a block of outputs, no atomics.

A program owns a block of output rows and channels; it walks the kernel's offsets, gathers the input rows of each
through the table and multiplies them with the offset's weights. Half precision is added up in float32. Gradients with
respect to the input are the same product along the inverse table; those of the weights are summed in a fixed number of
stretches of output rows, which are then added in order. Results are the same from run to run.
"""
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.ops.sparse_conv.autograd import convolve_with
from beambox.ops.sparse_conv.pairs import input_rows
from beambox.ops.sparse_conv.sites import KernelMap

__all__ = ["convolve", "forward", "weight_grad"]

ROWS = 64
"""Output rows of a program."""
STRETCHES = 16
"""Parts in which the weights' gradient is summed."""


def convolve(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Gather, multiply and add, as :func:`beambox.ops.sparse_conv.reference.convolve` defines it; differentiable."""
    return convolve_with(forward, weight_grad, features, weight, bias, pairs)


def _width(channels: int) -> int:
    """Return the channels of a tile: a power of two from 16, the least that matrix units take, to 64."""
    return min(64, max(16, triton.next_power_of_2(channels)))


def forward(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Compute the convolution without recording gradients: ``(V_in, C_in)`` -> ``(V_out, C_out)``."""
    table = pairs.kept(input_rows)
    rows, offsets = table.shape
    c_in, c_out = weight.shape[1:]
    out = features.new_empty((rows, c_out))
    if rows == 0:
        return out
    grid = (triton.cdiv(rows, ROWS), triton.cdiv(c_out, _width(c_out)))
    _forward[grid](
        features.contiguous(),
        weight.contiguous(),
        None if bias is None else bias.contiguous(),
        table,
        out,
        rows,
        offsets,
        c_in,
        c_out,
        ROWS,
        _width(c_in),
        _width(c_out),
    )
    return out


def weight_grad(features: Tensor, grad: Tensor, pairs: KernelMap) -> Tensor:
    """Compute the gradient of the weights: ``(K, C_in, C_out)``."""
    table = pairs.kept(input_rows)
    rows, offsets = table.shape
    c_in, c_out = features.shape[1], grad.shape[1]
    if rows == 0 or len(features) == 0:
        return features.new_zeros((offsets, c_in, c_out))
    stretch = triton.cdiv(triton.cdiv(rows, STRETCHES), ROWS) * ROWS
    stretches = triton.cdiv(rows, stretch)
    parts = torch.empty((stretches, offsets, c_in, c_out), dtype=torch.float32, device=features.device)
    tiles = triton.cdiv(c_in, _width(c_in)), triton.cdiv(c_out, _width(c_out))
    _weight_grad[(stretches * offsets, *tiles)](
        features.contiguous(),
        grad.contiguous(),
        table,
        parts,
        rows,
        offsets,
        c_in,
        c_out,
        stretch,
        ROWS,
        _width(c_in),
        _width(c_out),
    )
    return parts.sum(dim=0).to(features.dtype)


@triton.jit
def _forward(
    features,
    weight,
    bias,
    table,
    out,
    rows,
    offsets,
    c_in,
    c_out,
    block: tl.constexpr,
    in_width: tl.constexpr,
    out_width: tl.constexpr,
):
    row = tl.program_id(0) * block + tl.arange(0, block)
    column = tl.program_id(1) * out_width + tl.arange(0, out_width)
    channel = tl.arange(0, in_width)
    total = tl.zeros((block, out_width), tl.float32)
    for k in range(offsets):
        source = tl.load(table + row * offsets + k, row < rows, -1)
        if tl.max(source, axis=0) >= 0:  # few blocks have all offsets
            start = source.to(tl.int64) * c_in
            for first in range(0, c_in, in_width):
                inner = first + channel
                x = tl.load(
                    features + start[:, None] + inner[None, :],
                    (source >= 0)[:, None] & (inner < c_in)[None, :],
                    0.0,
                )
                w = tl.load(
                    weight + (k * c_in + inner)[:, None] * c_out + column[None, :],
                    (inner < c_in)[:, None] & (column < c_out)[None, :],
                    0.0,
                )
                total = tl.dot(x, w, total, input_precision="ieee")
    if bias is not None:
        total += tl.load(bias + column, column < c_out, 0.0).to(tl.float32)[None, :]
    place = row.to(tl.int64)[:, None] * c_out + column[None, :]
    tl.store(out + place, total.to(out.dtype.element_ty), (row < rows)[:, None] & (column < c_out)[None, :])


@triton.jit
def _weight_grad(
    features,
    grad,
    table,
    parts,
    rows,
    offsets,
    c_in,
    c_out,
    stretch,
    block: tl.constexpr,
    in_width: tl.constexpr,
    out_width: tl.constexpr,
):
    part, k = tl.program_id(0) // offsets, tl.program_id(0) % offsets
    channel = tl.program_id(1) * in_width + tl.arange(0, in_width)
    column = tl.program_id(2) * out_width + tl.arange(0, out_width)
    total = tl.zeros((in_width, out_width), tl.float32)
    for first in range(0, stretch, block):
        row = part * stretch + first + tl.arange(0, block)
        source = tl.load(table + row * offsets + k, row < rows, -1)
        if tl.max(source, axis=0) >= 0:
            has = source >= 0
            x = tl.load(
                features + source.to(tl.int64)[None, :] * c_in + channel[:, None],
                has[None, :] & (channel < c_in)[:, None],
                0.0,
            )  # (in_width, block)
            g = tl.load(
                grad + row.to(tl.int64)[:, None] * c_out + column[None, :],
                has[:, None] & (column < c_out)[None, :],
                0.0,
            )
            total = tl.dot(x, g, total, input_precision="ieee")
    place = (part * offsets + k).to(tl.int64) * c_in * c_out + channel[:, None] * c_out + column[None, :]
    tl.store(parts + place, total, (channel < c_in)[:, None] & (column < c_out)[None, :])
