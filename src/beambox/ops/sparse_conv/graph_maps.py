"""Kernel maps for a graph that is being exported; see :mod:`beambox.ops.sparse_conv.graph`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from beambox.geometry.constants import constant
from beambox.ops.sparse_conv.sites import ConvSpec, Sites

__all__ = ["MAP_CELLS", "find_targets", "lower_bound", "neighbor_table"]

MAP_CELLS = 1 << 24
"""Cells of a level up to which rows are looked up in a map of it, four bytes a cell; beyond, lines are searched."""


def find_targets(source: Sites, spec: ConvSpec) -> Tensor:
    """Return the ascending keys of every output whose receptive field holds an active input."""
    shape = spec.output_shape(source.shape)
    index = source.indices
    place = index[:, None, 1:] - spec.offset_table(index.device)  # (V, K, 3) output * stride
    stride, extent = constant(spec.stride, index.device), constant(shape, index.device)
    target = torch.div(place, stride, rounding_mode="floor")  # (V, K, 3)
    lands = ((target * stride == place) & (target >= 0) & (target < extent)).all(dim=2)  # (V, K)
    line = (index[:, :1] * shape[0] + target[..., 0]) * shape[1] + target[..., 1]  # (V, K)
    cells = source.batch_size * math.prod(shape)
    key = torch.where(lands, line * shape[2] + target[..., 2], cells)  # one cell more takes what lands nowhere
    reached = torch.zeros(cells + 1, dtype=torch.uint8, device=index.device)
    reached = reached.scatter(0, key.flatten(), torch.ones_like(key.flatten(), dtype=torch.uint8))
    return torch.nonzero(reached[:cells])[:, 0]


def neighbor_table(source: Sites, target: Sites, spec: ConvSpec) -> Tensor:
    """Find the input row that reaches each output through each kernel offset: ``(V_out, K)`` int64, -1 for none."""
    nz, ny, nx = source.shape
    device = source.sorted_keys.device
    stride, extent = constant(spec.stride, device), constant(source.shape, device)
    place = target.indices[:, None, 1:] * stride + spec.offset_table(device)  # (V_out, K, 3)
    inside = (place >= 0) & (place < extent)
    line = (target.indices[:, :1] * nz + place[..., 0]) * ny + place[..., 1]  # (V_out, K)
    line = torch.where(inside[..., :2].all(dim=2), line, 0)
    inside = inside.all(dim=2)
    cells = source.batch_size * nz * ny * nx
    if cells > MAP_CELLS:
        return torch.where(inside, search(source, line, place[..., 2], spec), -1)
    rows = torch.full((cells,), -1, dtype=torch.int32, device=device)
    rows = rows.scatter(0, source.sorted_keys, source.order.int())
    return torch.where(inside, rows[line * nx + torch.where(inside, place[..., 2], 0)].long(), -1)


def search(source: Sites, line: Tensor, x: Tensor, spec: ConvSpec) -> Tensor:
    """Find the row of the site at each x of each line of cells, -1 for none, by binary searches within lines.

    No number exceeds 2^24, so that runtimes which compute with integers in float32 are exact too.

    Args:
        source: the sites.
        line: ``(V_out, K)`` number of the line, ``(b Z + z) Y + y``.
        x: ``(V_out, K)``.
        spec: of the convolution; offsets of one row of its kernel ask for neighbors in x.
    """
    nz, ny, nx = source.shape
    index = source.indices[source.order]  # ascending
    of_site = (index[:, 0] * nz + index[:, 1]) * ny + index[:, 2]  # (V,)
    count = torch.zeros(source.batch_size * nz * ny, dtype=torch.int64, device=index.device)
    count = count.scatter_add(0, of_site, torch.ones_like(of_site))
    end = count.cumsum(0)  # (lines,) behind the last site of each
    begin = end - count
    behind = index.new_full((1,), -1)  # for searches that end behind the last site
    xs, order = torch.cat((index[:, 3], behind)), torch.cat((source.order, behind))
    width = spec.kernel[2] if spec.dilation[2] == 1 else 1
    last = end[line]  # (V_out, K)
    first = line[:, ::width]
    row = lower_bound(xs, begin[first], end[first], x[:, ::width], nx.bit_length())  # of the first of each row
    columns = []
    for k in range(width):
        found = (row < last[:, k::width]) & (xs[row] == x[:, k::width])
        columns.append(torch.where(found, order[row], -1))
        row = row + found.long()  # the lower bound of the next cell
    return torch.stack(columns, dim=2).flatten(1)


def lower_bound(values: Tensor, begin: Tensor, end: Tensor, wanted: Tensor, steps: int) -> Tensor:
    """Find the first place from ``begin`` to ``end`` whose value is not below the wanted one.

    Args:
        values: ``(V + 1,)``, ascending between ``begin`` and ``end``; the last one is never taken.
        begin: any shape, int64.
        end: of the same shape, V at most.
        wanted: of the same shape.
        steps: bits of the largest ``end - begin``.

    Returns:
        As many int64; ``end`` where all are below.
    """
    low = begin
    for bit in reversed(range(steps)):
        probe = low + ((1 << bit) - 1)
        below = (probe < end) & (values[torch.minimum(probe, end)] < wanted)
        low = torch.where(below, probe + 1, low)
    return low
