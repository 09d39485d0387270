"""Two-dimensional convolutions on bird's-eye-view maps (SECOND, section 3.1; PointPillars, section 2.2)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import accumulate, pairwise

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from beambox.checks import BeamboxError, expect_same_length
from beambox.ops.map_conv import GroundedConv, MapKernel

__all__ = [
    "BevBackbone",
    "ConvBnReLU",
    "conv_bn_relu",
    "deconv_bn_relu",
    "enlarge_and_join",
    "expect_levels_meet",
    "join_levels",
]

BN_EPS = 1e-3
BN_MOMENTUM = 0.01


class ConvBnReLU(nn.Sequential):
    """A convolution of maps, batch norm, ReLU; once folded, one operation."""

    _folded: GroundedConv | None = None

    @property
    def folded(self) -> GroundedConv | None:
        """The one operation, of the layer's present weights; None before it is folded."""
        kernel = None if self._folded is None else self._folded.kernel
        if kernel is not None and (kernel.weight is not self[0].weight or kernel.bias is not self[0].bias):
            self._folded = self.operation()  # somebody put other parameters in their place
        return self._folded

    def forward(self, bev: Tensor, out: Tensor | None = None) -> Tensor:
        """Map ``(B, C, Y, X)`` to ``(B, channels, Y', X')``; a folded block writes to ``out`` where it is given."""
        folded = self.folded
        if folded is not None:
            return folded(bev, out)
        return super().forward(bev)  # torch.compile passes over the forward of torch's own class and enters this one

    def fold(self) -> None:
        """Take the batch norm into the convolution for good; training ends here."""
        conv, norm, _ = self
        if not isinstance(conv, nn.Conv2d | nn.ConvTranspose2d) or not isinstance(norm, nn.BatchNorm2d):
            return  # it is folded already
        conv = fuse_conv_bn_eval(conv, norm, transpose=isinstance(conv, nn.ConvTranspose2d))
        self[0], self[1] = conv, nn.Identity()
        self._folded = self.operation()

    def operation(self) -> GroundedConv:
        """Make one operation of the folded convolution and ReLU."""
        conv = self[0]
        assert isinstance(conv, nn.Conv2d | nn.ConvTranspose2d)
        padding, output_padding = conv.padding, conv.output_padding
        assert isinstance(padding, tuple) and isinstance(output_padding, tuple)
        transposed = isinstance(conv, nn.ConvTranspose2d)
        options = (conv.stride[0], padding[0], conv.dilation[0], transposed, output_padding[0])
        return GroundedConv(MapKernel(conv.weight, conv.bias, *options, relu=True))


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
        for stage in self.stages:
            bev = stage(bev)
            levels.append(bev)
        return enlarge_and_join(self.ups, levels)


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


def enlarge_and_join(ups: Iterable[nn.Module], levels: Sequence[Tensor]) -> Tensor:
    """Enlarge each level and join them along the channels, cut to the first one's size.

    Folded blocks write to their place in the joined map, which saves a copy of it.
    """
    folded = [up.folded for up in ups if isinstance(up, ConvBnReLU) and up.folded is not None]
    if len(folded) < len(levels) or not all(up.is_fused(level) for up, level in zip(folded, levels)):
        return join_levels([up(level) for up, level in zip(ups, levels)])
    height, width = folded[0].kernel.size(levels[0].shape[2:])
    edges = list(accumulate((up.kernel.out_channels for up in folded), initial=0))
    joined = levels[0].new_empty((len(levels[0]), height, width, edges[-1])).permute(0, 3, 1, 2)
    for up, level, (low, high) in zip(folded, levels, pairwise(edges)):
        up(level, joined[:, low:high])
    return joined


def mean_over(bev: Tensor, dim: int) -> Tensor:
    """Average ``(B, C, Y, X)`` over rows (``dim`` 2) or columns (3) and keep the dimension.

    PyTorch's own mean takes seven times as long on maps that are laid out channels last.
    """
    if not bev.is_contiguous(memory_format=torch.channels_last) or torch.compiler.is_exporting():
        return bev.mean(dim=dim, keepdim=True)
    return bev.permute(0, 2, 3, 1).mean(dim=dim - 1, keepdim=True).permute(0, 3, 1, 2)


def join_levels(levels: Sequence[Tensor]) -> Tensor:
    """Join maps along the channels, cut to the first one's size (an odd size halved and doubled is one larger)."""
    height, width = levels[0].shape[-2:]
    return torch.cat([level[..., :height, :width] for level in levels], dim=1)
