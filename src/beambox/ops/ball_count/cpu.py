"""How many voxels lie around each voxel, by counting the bits of columns (numba).

A map in BEV holds one word per column, one bit per cell. In each column that the ball reaches, the cells within
reach are one ``and`` and one count of bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from beambox.ops.ball_count import reference
from beambox.ops.ball_count.columns import ball_columns, extent, map_too_large, padding
from beambox.ops.jit import jit, parallel_for

__all__ = ["ball_counts"]


def ball_counts(
    index: Tensor, cell: tuple[float, float, float], radii: tuple[float, ...], within: Any = None
) -> Tensor:
    """Count the voxels within some radii; see :func:`beambox.ops.ball_count.ball_counts`."""
    columns = [ball_columns(cell, radius) for radius in radii]
    pad_y, pad_x = padding(columns)
    low, span = extent(index)  # tighter than what is known, and looked at in no time
    if map_too_large(span, (pad_y, pad_x)):
        return reference.ball_counts(index, cell, radii)
    place = index.numpy() - np.array(low) + np.array([0, 0, pad_y, pad_x])
    shape = (span[1] // 64 + 1, span[2] + 2 * pad_y, span[3] + 2 * pad_x)  # words in z, y, x
    out = np.empty((len(radii), len(index)), np.int64)
    for sample in range(span[0]):
        cells = np.zeros((shape[0], shape[1] * shape[2]), np.uint64)
        after, tops = _stack(cells, place, sample, shape[2])
        for ball, counts in zip(columns, out):
            _count_ball(ball, cells, place, after, tops, shape[2], counts)
    return torch.from_numpy(out).t().contiguous()


def _count_ball(ball: Any, cells: Any, place: Any, after: Any, tops: Any, width: int, out: Any) -> None:
    """Write the counts of one sample's voxels for one ball's columns."""
    steps, heights = ball[:, 0] * width + ball[:, 1], ball[:, 2].copy()  # offsets in the flat map
    parallel_for(
        lambda start, stop: _count(cells, place, after, tops[start:stop], width, steps, heights, out),
        len(tops),
        smallest=256,
    )


def _count_ones(typing_context: Any, word: Any) -> Any:
    """Count the bits of a word that are set, by the processor's own instruction."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), generate


_ones: Any = intrinsic(_count_ones)


@jit
def _stack(cells, place, sample, width):
    """Set the bit of each voxel of a sample (word z // 64 of its column, bit z % 64) and chain those of a column.

    Returns:
        For each voxel the next one of its column, or -1; and for each column that has any, the first.
    """
    top = np.full(cells.shape[1], -1, np.int64)
    after = np.empty(len(place), np.int64)
    columns = np.empty(len(place), np.int64)
    n = 0
    for row in range(len(place)):
        if place[row, 0] != sample:
            continue
        z, column = place[row, 1], place[row, 2] * width + place[row, 3]
        cells[z >> 6, column] |= np.uint64(1) << np.uint64(z & 63)
        if top[column] < 0:
            columns[n] = column
            n += 1
        after[row] = top[column]
        top[column] = row
    return after, top[columns[:n]]


@jit
def _count(cells, place, after, tops, width, steps, heights, out):
    """Write the counts of the voxels of some columns."""
    tallest = heights.max()
    within = np.empty(tallest + 1, np.uint64)  # by height: the bits of a word within reach of a voxel
    around = np.empty(len(steps), np.uint64)  # the words around a column that are not empty, and their heights
    height_of = np.empty(len(steps), np.int64)
    everything = np.uint64(0xFFFFFFFFFFFFFFFF)
    for top in tops:
        center = place[top, 2] * width + place[top, 3]
        row = top
        while row >= 0:
            out[row] = 0
            row = after[row]
        for word in range(len(cells)):
            n = 0
            for k in range(len(steps)):  # without a branch: an empty word is overwritten by the next
                found = cells[word, center + steps[k]]
                around[n], height_of[n] = found, heights[k]
                n += found != 0
            row = top
            while row >= 0 and n > 0:
                z = place[row, 1] - 64 * word
                for height in range(tallest + 1):
                    low, high = max(z - height, 0), min(z + height, 63)
                    within[height] = 0
                    if low <= high:
                        within[height] = (everything << np.uint64(low)) & (everything >> np.uint64(63 - high))
                total = 0
                for k in range(n):
                    total += _ones(around[k] & within[height_of[k]])
                out[row] += total
                row = after[row]
