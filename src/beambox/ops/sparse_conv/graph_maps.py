"""Kernel maps for a graph that is being exported; see :mod:`beambox.ops.sparse_conv.graph`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from beambox.geometry.constants import constant
from beambox.ops.sparse_conv.sites import ConvSpec, Sites

__all__ = ["MAP_CELLS", "MOST_SITES", "find_targets", "lower_bound", "neighbor_table"]

MAP_CELLS = 1 << 24
"""Cells of a level up to which rows are looked up in a map of it, four bytes a cell; beyond, keys are searched."""
MOST_SITES = 1 << 21
"""Sites of a level that the search can tell apart; a sweep has some ten thousand."""


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
    inside = ((place >= 0) & (place < extent)).all(dim=2)
    line = (target.indices[:, :1] * nz + place[..., 0]) * ny + place[..., 1]
    wanted = line * nx + place[..., 2]  # (V_out, K)
    cells = source.batch_size * nz * ny * nx
    if cells <= MAP_CELLS:
        rows = torch.full((cells,), -1, dtype=torch.int32, device=device)
        rows = rows.scatter(0, source.sorted_keys, source.order.int())
        return torch.where(inside, rows[torch.where(inside, wanted, 0)].long(), -1)
    return torch.where(inside, search(source, wanted, spec, min(MOST_SITES, cells).bit_length()), -1)


def search(source: Sites, wanted: Tensor, spec: ConvSpec, steps: int) -> Tensor:
    """Find the row of each wanted key ``(V_out, K)``, -1 for none, by one binary search per row of the kernel."""
    keys = torch.cat((source.sorted_keys, source.sorted_keys.new_full((1,), torch.iinfo(torch.int64).max)))
    order = torch.cat((source.order, source.order.new_full((1,), -1)))  # the search may end behind the last one
    width = spec.kernel[2] if spec.dilation[2] == 1 else 1
    row = lower_bound(keys, wanted[:, ::width], steps)  # (V_out, K / width) of the first of each row of the kernel
    columns = []
    for k in range(width):
        found = keys[row] == wanted[:, k::width]
        columns.append(torch.where(found, order[row], -1))
        row = row + found.long()  # the lower bound of the next cell
    return torch.stack(columns, dim=2).flatten(1)


def lower_bound(keys: Tensor, wanted: Tensor, steps: int) -> Tensor:
    """Count the keys below each wanted one, by a binary search.

    Args:
        keys: ``(V + 1,)`` ascending, the last one larger than all that is wanted.
        wanted: any shape.
        steps: bits of the largest answer.

    Returns:
        As many int64, at most V.
    """
    low = torch.zeros_like(wanted)
    for bit in reversed(range(steps)):
        probe = low + ((1 << bit) - 1)
        below = keys[probe.clamp(max=keys.shape[0] - 1)] < wanted
        low = torch.where(below, probe + 1, low)
    return low
