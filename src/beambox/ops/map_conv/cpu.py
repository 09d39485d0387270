"""Convolution of maps on the CPU: products in register tiles, and nothing where the answer is known.

Where a map equals that of empty ground in all cells which an output sees, the output is that of empty ground, and is
copied. What is left is cut into base cells (:class:`beambox.ops.map_conv.packed.Packed`): output cells, or 2 x 2 of
them where Winograd's F(2 x 2, 3 x 3) applies, which needs 16 multiplications in place of 36. Bias and ReLU are applied
to the sums before they leave the registers. Each cell is computed by itself, in one order of additions, whatever its
neighbours and however many threads: its bits depend on its inputs and, by Winograd, on whether its row and column are
even.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit, parallel_for
from beambox.ops.map_conv.kernel import Folded, Ground, MapKernel
from beambox.ops.map_conv.packed import Packed
from beambox.ops.map_conv.tiles import LANES, ROWS, WIDE, products, transform_input, transform_output

__all__ = ["map_conv"]

CHUNK = 48
"""Base cells worked on together: their transformed rows should stay in a core's own cache."""

_products_1, _products_2, _products_3, _products_4 = (products[n] for n in (1, 2, 3, 4))


def map_conv(bev: Tensor, kernel: MapKernel, ground: Ground | None = None, out: Tensor | None = None) -> Tensor:
    """Convolve, as :func:`beambox.ops.map_conv.reference.map_conv` defines it."""
    packed = kernel.kept("packed", Packed.of)
    x = bev.permute(0, 2, 3, 1).contiguous()  # (B, Y, X, C)
    size = kernel.size(x.shape[1:3])
    if out is None:
        out = torch.empty((len(x), *size, kernel.out_channels)).permute(0, 3, 1, 2)
    y = out.permute(0, 2, 3, 1)  # (B, Y', X', C') of a buffer with perhaps more channels
    base = tuple(-(-n // packed.out_step) for n in size) if packed.out_step > 1 else size
    cells = active_cells(x, packed, base, ground, y)
    floor = np.float32(0.0 if kernel.relu else -np.inf)
    values, result = x.numpy(), y.numpy()

    def work(kernel: Callable[[int, int], None]) -> None:
        parallel_for(kernel, len(cells), CHUNK)

    if packed.winograd is not None:
        panels = packed.winograd
        work(lambda a, b: _winograd(values, panels, packed.bias, floor, cells, base, result, a, b))
    for phase in packed.phases:
        steps = (packed.in_step, packed.out_step, *phase.at)
        work(
            lambda a, b, phase=phase, steps=steps: _direct(
                values, phase.taps, phase.weights, packed.bias, floor, cells, base, steps, result, a, b
            )
        )
    return out


def active_cells(x: Tensor, packed: Packed, base: tuple[int, ...], ground: Ground | None, y: Tensor) -> np.ndarray:
    """List the base cells to compute, and copy the answer of empty ground to all others."""
    total = len(x) * base[0] * base[1]
    if ground is None:
        return np.arange(total)
    differs = np.empty(x.shape[:3], np.bool_)
    table, row, column = arrays(ground.given)
    bits = x.numpy().view(np.int32)
    lines = len(x) * x.shape[1]
    parallel_for(lambda a, b: _differs(bits, table.view(np.int32), row, column, differs, a, b), lines, 16)
    active = np.empty((len(x), *base), np.bool_)
    table, row, column = arrays(ground.answer)
    result = y.numpy()
    parallel_for(
        lambda a, b: _reach_and_fill(
            differs, packed.in_step, packed.low, packed.high, active, packed.out_step, table, row, column, result, a, b
        ),
        len(x) * base[0],
        8,
    )
    return np.flatnonzero(active)


def arrays(folded: Folded) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return table, rows and columns."""
    return folded.table.numpy(), folded.row.numpy(), folded.column.numpy()


@jit
def _differs(x, table, row, column, differs, first, last):
    """Compare each cell of a map with empty ground, bit by bit."""
    height, width, channels = x.shape[1], x.shape[2], x.shape[3]
    for line in range(first, last):
        b, i = line // height, line % height
        for j in range(width):
            cell, known = x[b, i, j], table[row[i], column[j]]
            c, different = 0, np.int32(0)
            while different == 0 and c + 16 <= channels:
                for k in range(16):
                    different |= cell[c + k] ^ known[c + k]
                c += 16
            while different == 0 and c < channels:
                different |= cell[c] ^ known[c]
                c += 1
            differs[b, i, j] = different != 0


@jit
def _reach_and_fill(differs, in_step, low, high, active, out_step, table, row, column, out, first, last):
    """Mark the base cells that see a difference; copy the answer of empty ground to the others."""
    rows, columns = active.shape[1], active.shape[2]
    height, width = differs.shape[1], differs.shape[2]
    seen = np.empty(width, np.bool_)
    for line in range(first, last):
        b, i = line // rows, line % rows
        seen[:] = False
        for k in range(max(0, i * in_step + low[0]), min(height, i * in_step + high[0] + 1)):
            for j in range(width):
                seen[j] |= differs[b, k, j]
        for j in range(columns):
            found = False
            for k in range(max(0, j * in_step + low[1]), min(width, j * in_step + high[1] + 1)):
                found |= seen[k]
            active[b, i, j] = found
            if not found:
                for u in range(i * out_step, min(out.shape[1], (i + 1) * out_step)):
                    for v in range(j * out_step, min(out.shape[2], (j + 1) * out_step)):
                        known, cell = table[row[u], column[v]], out[b, u, v]
                        for c in range(len(cell)):
                            cell[c] = known[c]


@jit
def _multiply(rows, taps, channels, weights, across, start, targets, column, floor):
    if across == 4:
        if WIDE >= 4:  # else it would be compiled for registers that are not there
            _products_4(rows, taps, channels, weights, start, targets, column, floor)
    elif across == 3:
        if WIDE >= 4:
            _products_3(rows, taps, channels, weights, start, targets, column, floor)
    elif across == 2:
        _products_2(rows, taps, channels, weights, start, targets, column, floor)
    else:
        _products_1(rows, taps, channels, weights, start, targets, column, floor)


@jit
def _direct(x, taps, panels, bias, floor, cells, base, steps, out, first, last):
    """Compute one phase of some base cells: six at a time, all taps, panel after panel."""
    height, width, channels = x.shape[1], x.shape[2], x.shape[3]
    in_step, out_step = steps[0], steps[1]
    zero, nowhere = np.zeros(channels, np.float32), np.empty(out.shape[3], np.float32)
    rows = np.empty((CHUNK // ROWS, max(1, len(taps)), ROWS), np.int64)
    targets = np.empty((CHUNK // ROWS, ROWS), np.int64)
    for begin in range(first, last, CHUNK):
        end = min(last, begin + CHUNK)
        groups = (end - begin + ROWS - 1) // ROWS
        for place in range(groups * ROWS):
            group, r = place // ROWS, place % ROWS
            cell = cells[min(begin + place, end - 1)]
            j = cell % base[1]
            i = cell // base[1] % base[0]
            b = cell // (base[1] * base[0])
            u, v = i * out_step + steps[2], j * out_step + steps[3]
            inside = u < out.shape[1] and v < out.shape[2]
            targets[group, r] = out[b, u, v].ctypes.data if inside else nowhere.ctypes.data
            for t in range(len(taps)):
                y, z = i * in_step + taps[t, 0], j * in_step + taps[t, 1]
                inside = 0 <= y < height and 0 <= z < width
                rows[group, t, r] = x[b, y, z].ctypes.data if inside else zero.ctypes.data
        for p in range(len(panels.columns)):
            column = 4 * panels.columns[p]
            panel = panels.values.ctypes.data + 4 * panels.offset[p]
            for group in range(groups):
                _multiply(
                    rows[group].ctypes.data, len(taps), channels, panel, panels.across[p],
                    bias.ctypes.data + column, targets[group].ctypes.data, column, floor,
                )  # fmt: skip


@jit
def _winograd(x, panels, bias, floor, cells, base, out, first, last):
    """Compute 2 x 2 outputs of some base cells: transform their inputs, multiply, transform the products."""
    height, width, channels = x.shape[1], x.shape[2], x.shape[3]
    wide = out.shape[3]
    seen = np.empty((16, CHUNK, channels), np.float32)
    made = np.empty((16, CHUNK, wide), np.float32)
    zero, nowhere, nothing = np.zeros(channels, np.float32), np.empty(wide, np.float32), np.zeros(wide, np.float32)
    table, rows, targets = np.empty(16, np.int64), np.empty(ROWS, np.int64), np.empty(ROWS, np.int64)
    unbounded = np.float32(-np.inf)
    for begin in range(first, last, CHUNK):
        count = min(last - begin, CHUNK)
        for place in range(count):
            cell = cells[begin + place]
            j = cell % base[1]
            i = cell // base[1] % base[0]
            b = cell // (base[1] * base[0])
            for k in range(16):
                y, z = 2 * i - 1 + k // 4, 2 * j - 1 + k % 4
                inside = 0 <= y < height and 0 <= z < width
                table[k] = x[b, y, z].ctypes.data if inside else zero.ctypes.data
            transform_input(table.ctypes.data, channels, seen[0, place].ctypes.data, 4 * CHUNK * channels)
        for k in range(16):
            for p in range(len(panels.columns)):
                across = panels.across[p]
                panel = panels.values.ctypes.data + 4 * (panels.offset[p] + k * channels * across * LANES)
                for group in range(0, count, ROWS):
                    for r in range(ROWS):
                        place = min(group + r, count - 1)
                        rows[r] = seen[k, place].ctypes.data
                        targets[r] = made[k, place].ctypes.data
                    _multiply(
                        rows.ctypes.data, 1, channels, panel, across, nothing.ctypes.data, targets.ctypes.data,
                        4 * panels.columns[p], unbounded,
                    )  # fmt: skip
        for place in range(count):
            cell = cells[begin + place]
            j = cell % base[1]
            i = cell // base[1] % base[0]
            b = cell // (base[1] * base[0])
            for k in range(4):
                u, v = 2 * i + k // 2, 2 * j + k % 2
                inside = u < out.shape[1] and v < out.shape[2]
                table[k] = out[b, u, v].ctypes.data if inside else nowhere.ctypes.data
            transform_output(
                made[0, place].ctypes.data, 4 * CHUNK * wide, wide, bias.ctypes.data, table.ctypes.data, floor
            )
