"""Kernel maps on the CPU: outputs walked in ascending order, with one pointer into the inputs for each kernel row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit, parallel_for
from beambox.ops.sparse_conv.sites import ConvSpec, KernelMap, Sites, Triple
from beambox.ops.sparse_conv.tiles import ROWS

__all__ = ["BLOCK", "BlockPairs", "block_pairs", "find_pairs", "find_targets"]

BLOCK = 256
"""Output rows worked on together, a multiple of the tile's: their sums stay in the second-level cache."""


@dataclass(frozen=True)
class BlockPairs:
    """The pairs of a kernel map, grouped by block of output rows and then by kernel offset."""

    source: np.ndarray
    """``(blocks, K, BLOCK)`` int32 input rows."""
    target: np.ndarray
    """``(blocks, K, BLOCK)`` int32 output rows."""
    count: np.ndarray
    """``(blocks, K)`` int32 pairs of each group. The places up to the next multiple of a tile's rows hold input row 0
    and an output row of their own behind the last, one a block; places after these are undefined."""


def axis_tables(spec: ConvSpec, shape: Triple, out_shape: Triple, back: bool) -> tuple[np.ndarray, ...]:
    """Tell, for each axis, where each kernel offset leads from each coordinate: ``(n, k)`` int64, -1 for nowhere.

    Args:
        spec: of the convolution.
        shape: extent of its input.
        out_shape: extent of its output.
        back: from inputs to outputs; else from outputs to inputs.
    """
    tables = []
    sizes = zip(shape, out_shape, spec.kernel, spec.stride, spec.padding, spec.dilation)
    for n, m, kernel, stride, padding, dilation in sizes:
        offset = np.arange(kernel) * dilation - padding
        if back:
            scaled = np.arange(n)[:, None] - offset
            place, fits = scaled // stride, scaled % stride == 0
            tables.append(np.where(fits & (place >= 0) & (place < m), place, -1))
        else:
            place = np.arange(m)[:, None] * stride + offset
            tables.append(np.where((place >= 0) & (place < n), place, -1))
    return tuple(tables)


def find_targets(source: Sites, spec: ConvSpec) -> Tensor:
    """Return the ascending keys of every output whose receptive field holds an active input."""
    shape, out_shape = source.shape, spec.output_shape(source.shape)
    z, y, x = axis_tables(spec, shape, out_shape, back=True)
    found = _reached(source.sorted_keys.numpy(), np.array(shape), np.array(out_shape), z, y, x)
    found.sort()
    fresh = np.ones(len(found), dtype=bool)
    fresh[1:] = found[1:] != found[:-1]
    return torch.from_numpy(found[fresh])


@jit
def _reached(keys, shape, out_shape, z_table, y_table, x_table):
    """List the outputs that each input reaches, some more than once."""
    lines = z_table.shape[1] * y_table.shape[1]
    out = np.empty(len(keys) * lines * x_table.shape[1], np.int64)
    last = np.full(lines, -1, np.int64)
    n = 0
    for key in keys:
        x = key % shape[2]
        rest = key // shape[2]
        y = rest % shape[1]
        rest //= shape[1]
        z = rest % shape[0]
        b = rest // shape[0]
        for kz in range(z_table.shape[1]):
            if z_table[z, kz] < 0:
                continue
            for ky in range(y_table.shape[1]):
                if y_table[y, ky] < 0:
                    continue
                line = ((b * out_shape[0] + z_table[z, kz]) * out_shape[1] + y_table[y, ky]) * out_shape[2]
                of_line = kz * y_table.shape[1] + ky
                for kx in range(x_table.shape[1] - 1, -1, -1):  # so that x ascends
                    if x_table[x, kx] >= 0 and line + x_table[x, kx] != last[of_line]:
                        last[of_line] = line + x_table[x, kx]
                        out[n] = last[of_line]
                        n += 1
    return out[:n].copy()


def block_pairs(pairs: KernelMap) -> BlockPairs:
    """Build a map's pairs grouped as the CPU works on them; to be kept with the map: ``pairs.kept(block_pairs)``."""
    return find_pairs(pairs.source, pairs.target, pairs.spec, pairs.inverse_of is not None)


def find_pairs(source: Sites, target: Sites, spec: ConvSpec, back: bool) -> BlockPairs:
    """Find which input row reaches each output row through each kernel offset.

    Args:
        source: the sites that are read.
        target: the sites that are written.
        spec: of the convolution.
        back: whether the convolution runs from ``target`` to ``source``, and this is its inverse.
    """
    blocks = -(-len(target) // BLOCK)
    pairs = BlockPairs(
        np.empty((blocks, spec.offsets, BLOCK), np.int32),
        np.empty((blocks, spec.offsets, BLOCK), np.int32),
        np.zeros((blocks, spec.offsets), np.int32),
    )
    shapes = (target.shape, source.shape) if back else (source.shape, target.shape)
    tables = axis_tables(spec, *shapes, back)
    keys, order = source.sorted_keys.numpy(), source.order.numpy()
    out_keys, out_order = target.sorted_keys.numpy(), target.order.numpy()
    extents = np.array((source.shape, target.shape))

    def find(first: int, last: int) -> None:
        _find_pairs(
            keys, order, out_keys, out_order, extents, tables, pairs.source, pairs.target, pairs.count, first, last
        )

    parallel_for(find, blocks, 16)
    return pairs


@jit
def _find_pairs(keys, order, out_keys, out_order, extents, tables, sources, targets, count, first, last):
    """Fill the pairs of the blocks from ``first`` to ``last``."""
    shape, out_shape = extents[0], extents[1]
    z_table, y_table, x_table = tables
    size, ny, nx = len(keys), y_table.shape[1], x_table.shape[1]
    low, high = _spans(x_table)
    start = np.empty(z_table.shape[1] * ny, np.int64)  # where each neighbouring row of cells begins, or -1
    pointer = np.empty(len(start), np.int64)
    for block in range(first, last):
        pointer[:] = -1
        begin, end = 0, -1  # of the row of cells that the current output lies in
        for i in range(block * BLOCK, min(len(out_keys), (block + 1) * BLOCK)):
            if out_keys[i] >= end:
                line = out_keys[i] // out_shape[2]
                begin, end = line * out_shape[2], (line + 1) * out_shape[2]
                y, plane = line % out_shape[1], line // out_shape[1]
                z, b = plane % out_shape[0], plane // out_shape[0]
                for row in range(len(start)):
                    cz, cy = z_table[z, row // ny], y_table[y, row % ny]
                    start[row] = ((b * shape[0] + cz) * shape[1] + cy) * shape[2] if cz >= 0 and cy >= 0 else -1
            x = out_keys[i] - begin
            if high[x] < 0:
                continue
            for row in range(len(start)):
                if start[row] < 0:
                    continue
                at, wanted = pointer[row], start[row] + low[x]
                if at < 0:
                    at = np.searchsorted(keys, wanted)
                while at < size and keys[at] < wanted:
                    at += 1
                while at > 0 and keys[at - 1] >= wanted:
                    at -= 1
                pointer[row] = at
                if at == size or keys[at] > start[row] + high[x]:
                    continue
                for kx in range(nx):
                    if x_table[x, kx] < 0:
                        continue
                    wanted = start[row] + x_table[x, kx]
                    while at < size and keys[at] < wanted:
                        at += 1
                    while at > 0 and keys[at - 1] >= wanted:
                        at -= 1
                    if at < size and keys[at] == wanted:
                        k = row * nx + kx
                        place = count[block, k]
                        sources[block, k, place] = order[at]
                        targets[block, k, place] = out_order[i]
                        count[block, k] = place + 1
        _fill_tiles(sources[block], targets[block], count[block], len(out_keys) + block)


@jit
def _fill_tiles(sources, targets, count, spare):
    """Fill the last tile of each offset with pairs whose product goes to a spare row."""
    for k in range(len(count)):
        for place in range(count[k], -(-count[k] // ROWS) * ROWS):
            sources[k, place] = 0
            targets[k, place] = spare


@jit
def _spans(table):
    """Return the least and the greatest coordinate that each row of a table leads to; -1 as the greatest for none."""
    low, high = np.zeros(len(table), np.int64), np.full(len(table), -1, np.int64)
    for i in range(len(table)):
        for place in table[i]:
            if place >= 0:
                low[i] = place if high[i] < 0 else min(low[i], place)
                high[i] = max(high[i], place)
    return low, high
