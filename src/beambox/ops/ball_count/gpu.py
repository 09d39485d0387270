"""How many voxels lie around each voxel, by counting the bits of columns, on a GPU (Triton); see ``cpu.py``."""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false

from __future__ import annotations

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.ops.ball_count import reference
from beambox.ops.ball_count.columns import ball_columns, extent, map_too_large

__all__ = ["ball_count"]

BLOCK = 128


def ball_count(index: Tensor, cell: tuple[float, float, float], radius: float) -> Tensor:
    """Count the voxels within a radius; see :func:`beambox.ops.ball_count.ball_count`."""
    columns = ball_columns(cell, radius)
    low, span = extent(index)
    samples = span[0]
    if map_too_large([1, span[1], span[2] * samples, span[3]], columns):
        return reference.ball_count(index, cell, radius)
    pad_y, pad_x = (int(pad) for pad in np.abs(columns[:, :2]).max(axis=0))
    words, height, width = span[1] // 64 + 1, span[2] + 2 * pad_y, span[3] + 2 * pad_x

    sample, z, y, x = (index - index.new_tensor(low)).unbind(dim=1)
    column = (sample * height + y + pad_y) * width + x + pad_x  # (V,) in a map of all samples
    bits = torch.stack((column, z), dim=1).unique(dim=0)  # each bit once, as bits are added below
    cells = torch.zeros(words * samples * height * width, dtype=torch.int64, device=index.device)
    word = (bits[:, 1] >> 6) * (samples * height * width) + bits[:, 0]
    cells.index_add_(0, word, torch.ones_like(word) << (bits[:, 1] & 63))

    table = torch.from_numpy(columns).to(index.device)
    steps, heights = (table[:, 0] * width + table[:, 1]).contiguous(), table[:, 2].contiguous()
    out = torch.empty(len(index), dtype=torch.int64, device=index.device)
    _count[(triton.cdiv(len(index), BLOCK),)](
        cells,
        column,
        z.contiguous(),
        steps,
        heights,
        out,
        len(index),
        len(steps),
        words,
        samples * height * width,
        BLOCK,
    )
    return out


@triton.jit
def _count(cells, column, z, steps, heights, out, voxels, reach, words, map_size, block: tl.constexpr):
    """Count for one block of voxels."""
    voxel = tl.program_id(0) * block + tl.arange(0, block)
    has = voxel < voxels
    centre = tl.load(column + voxel, has, 0)
    level = tl.load(z + voxel, has, 0)
    total = tl.zeros((block,), tl.int64)
    for word in range(words):
        for k in range(reach):
            height = tl.load(heights + k)
            low = tl.maximum(level - height - 64 * word, 0)
            high = tl.minimum(level + height - 64 * word, 63)
            some = has & (low <= high)
            where = centre + tl.load(steps + k) + word * map_size
            found = tl.load(cells + where, some, 0).to(tl.uint64, bitcast=True)
            # Shift out what lies above and below; never by 64, which would be undefined.
            found = found << tl.where(some, 63 - high, 0).to(tl.uint64)
            found = found >> tl.where(some, 63 - high + low, 0).to(tl.uint64)
            total += _ones(found)
    tl.store(out + voxel, total, has)


@triton.jit
def _ones(word):
    """Count the bits that are set in words of 64: sums of 2, 4, then 8 bits side by side, then all bytes at once."""
    pairs = word - ((word >> 1) & 0x5555555555555555)
    nibbles = (pairs & 0x3333333333333333) + ((pairs >> 2) & 0x3333333333333333)
    octets = (nibbles + (nibbles >> 4)) & 0x0F0F0F0F0F0F0F0F
    return ((octets * 0x0101010101010101) >> 56).to(tl.int64)
