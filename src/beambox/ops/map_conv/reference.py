"""Convolution of maps in plain PyTorch: the definition."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from beambox.ops.map_conv.kernel import Ground, MapKernel

__all__ = ["map_conv"]


def map_conv(bev: Tensor, kernel: MapKernel, ground: Ground | None = None, out: Tensor | None = None) -> Tensor:
    """Convolve every cell, whatever is known of empty ground."""
    options = {"stride": kernel.stride, "padding": kernel.padding, "dilation": kernel.dilation}
    if kernel.transposed:
        made = functional.conv_transpose2d(
            bev, kernel.weight, kernel.bias, output_padding=kernel.output_padding, **options
        )
    else:
        made = functional.conv2d(bev, kernel.weight, kernel.bias, **options)
    made = functional.relu(made, inplace=True) if kernel.relu else made
    if out is None:
        return made
    return out.copy_(made[..., : out.shape[2], : out.shape[3]])
