"""Two-dimensional convolutions on bird's-eye-view maps (SECOND, section 3.1; PointPillars, section 2.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, expect_same_length

__all__ = ["BevBackbone", "ConvBnReLU", "conv_bn_relu", "deconv_bn_relu", "expect_levels_meet", "join_levels"]

BN_EPS = 1e-3
BN_MOMENTUM = 0.01


class ConvBnReLU(nn.Sequential):
    """A convolution of maps, batch norm, ReLU."""

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, C, Y, X)`` to ``(B, channels, Y', X')``."""
        return super().forward(bev)  # torch.compile passes over the forward of torch's own class and enters this one


def conv_bn_relu(in_channels: int, channels: int, kernel: int = 3, stride: int = 1, dilation: int = 1) -> ConvBnReLU:
    """Convolution that keeps the size (divided by ``stride``), batch norm (eps 1e-3, momentum 0.01), ReLU."""
    padding = dilation * (kernel // 2)
    return ConvBnReLU(
        nn.Conv2d(in_channels, channels, kernel, stride, padding, dilation, bias=False),
        nn.BatchNorm2d(channels, eps=BN_EPS, momentum=BN_MOMENTUM),
        nn.ReLU(inplace=True),
    )


def deconv_bn_relu(
    in_channels: int, channels: int, kernel: int, stride: int, padding: int = 0, output_padding: int = 0
) -> ConvBnReLU:
    """Transposed convolution that enlarges by ``stride``, batch norm, ReLU."""
    return ConvBnReLU(
        nn.ConvTranspose2d(in_channels, channels, kernel, stride, padding, output_padding, bias=False),
        nn.BatchNorm2d(channels, eps=BN_EPS, momentum=BN_MOMENTUM),
        nn.ReLU(inplace=True),
    )


class BevBackbone(nn.Module):
    """Stages of convolutions at falling resolution, each brought back to one size and joined.

    Stage i: one convolution with stride ``strides[i]`` and ``depths[i]`` further ones of width ``widths[i]``; its
    output is enlarged ``up_strides[i]`` times to ``up_widths[i]`` channels.

    Raises:
        BeamboxError: where the lists differ in length, or a stage would not come back to the size of the first.
    """

    def __init__(
        self,
        in_channels: int,
        depths: Sequence[int],
        strides: Sequence[int],
        widths: Sequence[int],
        up_strides: Sequence[int],
        up_widths: Sequence[int],
    ) -> None:
        super().__init__()
        expect_same_length(
            depths=len(depths),
            strides=len(strides),
            widths=len(widths),
            up_strides=len(up_strides),
            up_widths=len(up_widths),
        )
        expect_levels_meet(strides, up_strides)
        self.stages = nn.ModuleList()
        self.ups = nn.ModuleList()
        for depth, stride, width, up_stride, up_width in zip(depths, strides, widths, up_strides, up_widths):
            layers = [conv_bn_relu(in_channels, width, stride=stride)]
            layers += [conv_bn_relu(width, width) for _ in range(depth)]
            self.stages.append(nn.Sequential(*layers))
            self.ups.append(deconv_bn_relu(width, up_width, up_stride, up_stride))
            in_channels = width
        self.out_channels = sum(up_widths)

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, out_channels, Y / s, X / s)``, s the first stage's net stride."""
        levels = []
        for stage, up in zip(self.stages, self.ups):
            bev = stage(bev)
            levels.append(up(bev))
        return join_levels(levels)


def expect_levels_meet(strides: Sequence[int], up_strides: Sequence[int]) -> None:
    """Check that every stage comes back to the size of the first.

    Raises:
        BeamboxError: naming the enlargements that do.
    """
    needed = [math.prod(strides[1 : stage + 1]) for stage in range(len(strides))]
    if list(up_strides) != needed:
        raise BeamboxError(
            f"`up_strides` must bring every stage back to the size of the first: with strides {list(strides)} they "
            f"are {needed}, got {list(up_strides)}"
        )


def join_levels(levels: Sequence[Tensor]) -> Tensor:
    """Join maps along the channels, cut to the first one's size (an odd size halved and doubled is one larger)."""
    height, width = levels[0].shape[-2:]
    return torch.cat([level[..., :height, :width] for level in levels], dim=1)
