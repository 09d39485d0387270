"""Kernel maps on a GPU (Triton): every neighbour is looked up at once, and no step of it is waited for but one.

Whether an output is active is a byte in a map of its level's cells, so the sites of all levels of an encoder are found
one from the other before anybody asks how many there are; then that is asked once, for all levels.
"""
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.ops.sparse_conv.sites import ConvSpec, Sites

__all__ = ["find_levels", "inverse_table", "neighbor_table"]

BLOCK = 128


def neighbor_table(source: Sites, target: Sites, spec: ConvSpec) -> Tensor:
    """Find the input row that reaches each output through each offset; see ``reference.neighbor_table``."""
    rows, offsets = len(target), spec.offsets
    table = torch.empty((rows, offsets), dtype=torch.int32, device=source.sorted_keys.device)
    if rows:
        _look_up[(triton.cdiv(rows, BLOCK), offsets)](
            source.sorted_keys, source.order, target.sorted_keys, target.order, table, rows, len(source),
            len(source).bit_length(), *target.shape, *source.shape, offsets, *spec.kernel[1:], *spec.stride,
            *spec.padding, *spec.dilation, BLOCK,
        )  # fmt: skip
    return table


def inverse_table(forward: Tensor, rows: int) -> Tensor:
    """Read a ``(V_out, K)`` table from output to input: ``(rows, K)``."""
    back = torch.full((rows, forward.shape[1]), -1, dtype=torch.int32, device=forward.device)
    if forward.numel():
        _turn_round[(triton.cdiv(forward.numel(), 1024),)](forward, back, forward.numel(), forward.shape[1], 1024)
    return back


def find_levels(source: Sites, specs: Sequence[ConvSpec]) -> list[Sites]:
    """Return the sites after each of a chain of strided convolutions; the host waits once."""
    device, batch = source.sorted_keys.device, source.batch_size
    maps, shapes, shape = [], [], source.shape
    for spec in specs:
        before, shape = shape, spec.output_shape(shape)
        active = torch.zeros(batch * math.prod(shape), dtype=torch.int8, device=device)
        count = len(source) if not maps else maps[-1].numel()
        if count:
            _spread[(triton.cdiv(count, BLOCK),)](
                source.sorted_keys if not maps else maps[-1], active, count, not maps, *before, *shape,
                *spec.kernel, *spec.stride, *spec.padding, *spec.dilation, BLOCK,
            )  # fmt: skip
        maps.append(active)
        shapes.append(shape)
    counts = torch.stack([active.sum(dtype=torch.int64) for active in maps]).tolist()
    found = [
        torch.nonzero_static(active, size=count).flatten() if count else active[:0].long()
        for active, count in zip(maps, counts)
    ]
    return [Sites.from_keys(keys, shape, batch) for keys, shape in zip(found, shapes)]


@triton.jit
def _look_up(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    keys, order, target_keys, target_order, table, rows, sources, steps, tz, ty, tx, nz, ny, nx, offsets, ky, kx,
    sz, sy, sx, pz, py, px, dz, dy, dx, block: tl.constexpr,
):  # fmt: skip
    """Search the input of one block of outputs through one offset."""
    at = tl.program_id(0) * block + tl.arange(0, block)
    k = tl.program_id(1)
    has = at < rows
    key = tl.load(target_keys + at, has, 0)
    x = (key % tx) * sx - px + (k % kx) * dx
    y = (key // tx % ty) * sy - py + (k // kx % ky) * dy
    z = (key // tx // ty % tz) * sz - pz + (k // (kx * ky)) * dz
    inside = has & (z >= 0) & (z < nz) & (y >= 0) & (y < ny) & (x >= 0) & (x < nx)
    wanted = ((key // tx // ty // tz * nz + z) * ny + y) * nx + x
    low = tl.zeros((block,), tl.int64)  # the first source whose key is not smaller lies in low .. high
    high = low + sources
    for _ in range(steps):
        middle = (low + high) // 2
        smaller = tl.load(keys + middle, inside & (middle < sources), 0) < wanted
        low = tl.where(smaller & (low < high), middle + 1, low)
        high = tl.where(smaller, high, middle)
    there = inside & (low < sources)
    hit = there & (tl.load(keys + low, there, -1) == wanted)
    row = tl.load(target_order + at, has, 0)
    tl.store(table + row * offsets + k, tl.load(order + low, hit, -1).to(tl.int32), has)


@triton.jit
def _turn_round(forward, back, total, offsets, block: tl.constexpr):
    """Write the output's row where the input's stood; each pair of input and offset occurs once."""
    at = tl.program_id(0) * block + tl.arange(0, block)
    source = tl.load(forward + at, at < total, -1)
    tl.store(back + source.to(tl.int64) * offsets + at % offsets, (at // offsets).to(tl.int32), source >= 0)


@triton.jit
def _spread(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    source, active, count, listed: tl.constexpr, nz, ny, nx, tz, ty, tx, kz, ky, kx, sz, sy, sx, pz, py, px, dz, dy, dx,
    block: tl.constexpr,
):  # fmt: skip
    """Set the byte of every output that a block of inputs, listed by keys or set in a map, reaches."""
    at = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    has = at < count
    if listed:
        key = tl.load(source + at, has, 0)
    else:
        has = has & (tl.load(source + at, has, 0) != 0)
        key = at
    if tl.max(has.to(tl.int32), axis=0) > 0:  # most blocks of a map are empty
        b, z, y, x = key // nx // ny // nz, key // nx // ny % nz, key // nx % ny, key % nx
        for k in range(kz * ky * kx):
            at_z, at_y, at_x = z + pz - k // (kx * ky) * dz, y + py - k // kx % ky * dy, x + px - k % kx * dx
            lands = has & (at_z >= 0) & (at_y >= 0) & (at_x >= 0)
            lands = lands & (at_z % sz == 0) & (at_y % sy == 0) & (at_x % sx == 0)
            at_z, at_y, at_x = at_z // sz, at_y // sy, at_x // sx
            lands = lands & (at_z < tz) & (at_y < ty) & (at_x < tx)
            tl.store(active + ((b * tz + at_z) * ty + at_y) * tx + at_x, 1, lands)
