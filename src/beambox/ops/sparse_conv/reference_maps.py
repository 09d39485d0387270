"""Kernel maps as they are defined: which outputs are active, and which input row reaches each through each offset."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.sparse_conv.sites import ConvSpec, Sites, linear_keys

__all__ = ["find_targets", "inverse_table", "neighbor_table"]


def find_targets(source: Sites, spec: ConvSpec) -> Tensor:
    """Return the ascending keys of every output whose receptive field holds an active input."""
    shape = spec.output_shape(source.shape)
    stride = torch.tensor(spec.stride, device=source.indices.device)
    extent = torch.tensor(shape, device=source.indices.device)
    scaled = source.indices[:, None, 1:] - spec.offset_table(source.indices.device)  # (V, K, 3) output * stride
    place = scaled // stride
    lands = ((scaled % stride == 0) & (place >= 0) & (place < extent)).all(dim=-1)  # (V, K)
    batch = source.indices[:, None, :1].expand(-1, place.shape[1], 1)
    return torch.unique(linear_keys(torch.cat((batch, place), dim=-1)[lands], shape))


def neighbor_table(source: Sites, target: Sites, spec: ConvSpec) -> Tensor:
    """Find the input row that reaches each output through each kernel offset.

    Returns:
        ``(V_out, K)`` int32, -1 where no active site lies there.
    """
    device = source.indices.device
    table = torch.full((len(target), spec.offsets), -1, dtype=torch.int32, device=device)
    if len(source) == 0:
        return table
    extent = torch.tensor(source.shape, device=device)
    center = target.indices[:, 1:] * torch.tensor(spec.stride, device=device)  # (V_out, 3)
    for k, offset in enumerate(spec.offset_table(device)):
        place = center + offset
        inside = ((place >= 0) & (place < extent)).all(dim=1)  # (V_out,)
        key = linear_keys(torch.cat((target.indices[:, :1], place), dim=1), source.shape)
        slot = torch.searchsorted(source.sorted_keys, key).clamp_(max=len(source) - 1)
        found = inside & (source.sorted_keys[slot] == key)
        table[:, k] = torch.where(found, source.order[slot], -1).int()
    return table


def inverse_table(forward: Tensor, rows: int) -> Tensor:
    """Read a ``(V_out, K)`` table from output to input: ``(rows, K)`` int32."""
    back = torch.full((rows, forward.shape[1]), -1, dtype=torch.int32, device=forward.device)
    out_row, offset = torch.nonzero(forward >= 0, as_tuple=True)  # each (input, offset) pair occurs once
    back[forward[out_row, offset].long(), offset] = out_row.int()
    return back
