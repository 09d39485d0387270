"""Sparse convolution as it is defined: one matrix product a kernel offset, summed at the output sites.

``out[o] = bias + sum over k of in[input site at o * stride - padding + k * dilation] @ weight[k]``, where absent sites
count as zero (Graham, Engelcke, van der Maaten, "3D Semantic Segmentation with Submanifold Sparse Convolutional
Networks", section 3). Runs on any device and differentiates by autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.sparse_conv.sites import Geometry, KernelMap, Sites, linear_keys

__all__ = ["convolve", "find_targets", "indices_of", "inverse_table", "neighbour_table"]


def find_targets(source: Sites, geometry: Geometry) -> Tensor:
    """Return the ascending keys of every output whose receptive field holds an active input."""
    shape = geometry.output_shape(source.shape)
    stride = torch.tensor(geometry.stride, device=source.indices.device)
    extent = torch.tensor(shape, device=source.indices.device)
    scaled = source.indices[:, None, 1:] - geometry.offset_table(source.indices.device)  # (V, K, 3) output * stride
    place = scaled // stride
    lands = ((scaled % stride == 0) & (place >= 0) & (place < extent)).all(dim=-1)  # (V, K)
    batch = source.indices[:, None, :1].expand(-1, place.shape[1], 1)
    return torch.unique(linear_keys(torch.cat((batch, place), dim=-1)[lands], shape))


def neighbour_table(source: Sites, target: Sites, geometry: Geometry) -> Tensor:
    """Find the input row that reaches each output through each kernel offset.

    Returns:
        ``(V_out, K)`` int32, -1 where no active site lies there.
    """
    device = source.indices.device
    table = torch.full((len(target), geometry.offsets), -1, dtype=torch.int32, device=device)
    if len(source) == 0:
        return table
    extent = torch.tensor(source.shape, device=device)
    centre = target.indices[:, 1:] * torch.tensor(geometry.stride, device=device)  # (V_out, 3)
    for k, offset in enumerate(geometry.offset_table(device)):
        place = centre + offset
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


def indices_of(sites: Sites) -> Tensor:
    """Return ``(V, 4)`` int64 (b, z, y, x) of each row."""
    nz, ny, nx = sites.shape
    rest, x = sites.sorted_keys // nx, sites.sorted_keys % nx
    rest, y = rest // ny, rest % ny
    ascending = torch.stack((rest // nz, rest % nz, y, x), dim=1)
    return torch.empty_like(ascending).index_copy_(0, sites.order, ascending)


def convolve(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Gather, multiply and add up, one kernel offset after the other.

    Args:
        features: ``(V_in, C_in)``.
        weight: ``(K, C_in, C_out)``.
        bias: ``(C_out,)`` or None.
        pairs: which input feeds which output.

    Returns:
        ``(V_out, C_out)`` in the type of ``features``; half precision is added up in float32.
    """
    table = pairs.table
    wide = torch.promote_types(features.dtype, torch.float32)
    out = features.new_zeros((len(table), weight.shape[2]), dtype=wide)
    for k in range(table.shape[1]):
        target = torch.nonzero(table[:, k] >= 0)[:, 0]
        source = table[target, k].long()
        out = out.index_add(0, target, (features[source] @ weight[k]).to(wide))
    if bias is not None:
        out = out + bias
    return out.to(features.dtype)
