"""Sparse convolution for a graph that is being exported: gathers, matrix products, binary searches.

Operators of ONNX alone, sizes known no earlier than values. The sites of a strided convolution are read from a map of
its output, one byte a cell. Kernel maps are looked up in a map of rows, or, where a level has too many cells, found by
a binary search with a fixed number of steps. Nothing is scattered but single elements, each to a place of its own.
"""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.sparse_conv.pairs import input_rows
from beambox.ops.sparse_conv.sites import KernelMap

__all__ = ["convolve"]


def convolve(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    """Gather all inputs of each output and multiply once; see :func:`reference.convolve`.

    What no input reaches gathers a row of zeros: more products than are needed, and no scattering.
    """
    table = pairs.kept(input_rows)  # (V_out, K)
    offsets, in_channels, channels = weight.shape
    padded = torch.cat((features, features.new_zeros(1, in_channels)))  # (V_in + 1, C_in)
    rows = torch.where(table < 0, features.shape[0], table)
    near = padded[rows.flatten()].view(-1, offsets * in_channels)  # (V_out, K * C_in)
    out = near @ weight.reshape(-1, channels)
    return out if bias is None else out + bias
