"""How many voxels lie around each voxel, by counting the bits of columns, on a GPU (Triton); see ``cpu.py``."""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.geometry.constants import constant
from beambox.ops.ball_count import reference
from beambox.ops.ball_count.columns import ball_columns, extent, map_too_large, padding

__all__ = ["ball_counts"]

BLOCK = 128


def ball_counts(
    index: Tensor,
    cell: tuple[float, float, float],
    radii: tuple[float, ...],
    within: tuple[int, int, int, int] | None = None,
) -> Tensor:
    """Count the voxels within some radii; see :func:`beambox.ops.ball_count.ball_counts`."""
    columns = [ball_columns(cell, radius) for radius in radii]
    pad_y, pad_x = padding(columns)
    low, span = extent(index) if within is None else ((0, 0, 0, 0), within)
    samples = span[0]
    if map_too_large([1, span[1], span[2] * samples, span[3]], (pad_y, pad_x)):
        return reference.ball_counts(index, cell, radii)
    words, height, width = span[1] // 64 + 1, span[2] + 2 * pad_y, span[3] + 2 * pad_x
    size, voxels, device = samples * height * width, len(index), index.device

    cells = torch.zeros(words * size, dtype=torch.int64, device=device)
    column, z = torch.empty((2, voxels), dtype=torch.int64, device=device)  # (V,) each; columns of all samples
    blocks = (triton.cdiv(voxels, BLOCK),)
    _stack[blocks](index.contiguous(), cells, column, z, voxels, size, *low, height, width, pad_y, pad_x, BLOCK)
    out = torch.empty((voxels, len(radii)), dtype=torch.int64, device=device)
    for place, ball in enumerate(columns):
        steps, heights = (constant(tuple(v.tolist()), device) for v in (ball[:, 0] * width + ball[:, 1], ball[:, 2]))
        _count[blocks](
            cells, column, z, steps, heights, out[:, place], voxels, len(steps), words, size, len(radii), BLOCK
        )
    return out


@triton.jit
def _stack(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    index, cells, column, z, voxels, size, low_b, low_z, low_y, low_x, height, width, pad_y, pad_x, block: tl.constexpr
):  # fmt: skip
    """Write each voxel's column and level, and set its bit: in any order, and twice does not matter."""
    voxel = tl.program_id(0) * block + tl.arange(0, block)
    has = voxel < voxels
    row = index + voxel.to(tl.int64) * 4
    sample, level = tl.load(row, has, 0) - low_b, tl.load(row + 1, has, 0) - low_z
    y, x = tl.load(row + 2, has, 0) - low_y + pad_y, tl.load(row + 3, has, 0) - low_x + pad_x
    place = (sample * height + y) * width + x
    tl.store(column + voxel, place, has)
    tl.store(z + voxel, level, has)
    one = tl.full((block,), 1, tl.int64)
    tl.atomic_or(cells + (level >> 6) * size + place, one << (level & 63), has)


@triton.jit
def _count(cells, column, z, steps, heights, out, voxels, reach, words, map_size, radii, block: tl.constexpr):
    """Count for one block of voxels."""
    voxel = tl.program_id(0) * block + tl.arange(0, block)
    has = voxel < voxels
    center = tl.load(column + voxel, has, 0)
    level = tl.load(z + voxel, has, 0)
    total = tl.zeros((block,), tl.int64)
    for word in range(words):
        for k in range(reach):
            height = tl.load(heights + k)
            low = tl.maximum(level - height - 64 * word, 0)
            high = tl.minimum(level + height - 64 * word, 63)
            some = has & (low <= high)
            where = center + tl.load(steps + k) + word * map_size
            found = tl.load(cells + where, some, 0).to(tl.uint64, bitcast=True)
            # Shift out what lies above and below; never by 64, which would be undefined.
            found = found << tl.where(some, 63 - high, 0).to(tl.uint64)
            found = found >> tl.where(some, 63 - high + low, 0).to(tl.uint64)
            total += _ones(found)
    tl.store(out + voxel * radii, total, has)


@triton.jit
def _ones(word):
    """Count the bits that are set in words of 64: sums of 2, 4, then 8 bits side by side, then all bytes at once."""
    pairs = word - ((word >> 1) & 0x5555555555555555)
    nibbles = (pairs & 0x3333333333333333) + ((pairs >> 2) & 0x3333333333333333)
    octets = (nibbles + (nibbles >> 4)) & 0x0F0F0F0F0F0F0F0F
    return ((octets * 0x0101010101010101) >> 56).to(tl.int64)
