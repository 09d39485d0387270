"""Sparse convolution as it is defined: one matrix product a kernel offset, summed at the output sites.

``out[o] = bias + sum over k of in[input site at o * stride - padding + k * dilation] @ weight[k]``, where absent sites
count as zero (Graham, Engelcke, van der Maaten, "3D Semantic Segmentation with Submanifold Sparse Convolutional
Networks", section 3). Runs on any device and differentiates by autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.sparse_conv.pairs import input_rows
from beambox.ops.sparse_conv.reference_maps import find_targets, inverse_table, neighbor_table
from beambox.ops.sparse_conv.sites import KernelMap

__all__ = ["convolve", "find_targets", "inverse_table", "neighbor_table"]


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
    table = pairs.kept(input_rows)
    wide = torch.promote_types(features.dtype, torch.float32)
    out = features.new_zeros((len(table), weight.shape[2]), dtype=wide)
    for k in range(table.shape[1]):
        target = torch.nonzero(table[:, k] >= 0)[:, 0]
        source = table[target, k].long()
        out = out.index_add(0, target, (features[source] @ weight[k]).to(wide))
    if bias is not None:
        out = out + bias
    return out.to(features.dtype)
