"""What KASSD's table 5 puts in place of its own feature extraction: PSA, DenseASPP and SPP on bird's-eye-view maps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from beambox.layers.bev import conv_bn_relu, deconv_bn_relu

__all__ = ["DenseASPP", "PyramidAttention", "SpatialPyramidPooling"]


class SpatialPyramidPooling(nn.Module):
    """Maxima over windows of several sizes beside the map itself, mixed by a 1 x 1 convolution (He et al., 2015).

    The size is kept, as where detectors insert it, not the fixed-size output of the original.
    """

    def __init__(self, channels: int, windows: Sequence[int] = (5, 9, 13)) -> None:
        super().__init__()
        self.pools = nn.ModuleList(nn.MaxPool2d(size, stride=1, padding=size // 2) for size in windows)
        self.mix = conv_bn_relu(channels * (1 + len(windows)), channels, kernel=1)

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, channels, Y, X)`` to the same shape."""
        return self.mix(torch.cat([bev, *(pool(bev) for pool in self.pools)], dim=1))


class DenseASPP(nn.Module):
    """Dilated convolutions, each seeing all before it (Yang et al., CVPR 2018), of half the map's width inside."""

    def __init__(self, channels: int, dilations: Sequence[int] = (3, 6, 12, 18)) -> None:
        super().__init__()
        width, growth = channels // 2, channels // 4
        self.reduce = conv_bn_relu(channels, width, kernel=1)
        self.branches = nn.ModuleList(
            nn.Sequential(
                conv_bn_relu(width + i * growth, width, kernel=1), conv_bn_relu(width, growth, dilation=dilation)
            )
            for i, dilation in enumerate(dilations)
        )
        self.mix = conv_bn_relu(width + len(dilations) * growth, channels, kernel=1)

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, channels, Y, X)`` to the same shape."""
        seen = self.reduce(bev)  # (B, channels / 2, Y, X)
        for branch in self.branches:
            seen = torch.cat((seen, branch(seen)), dim=1)  # a quarter of the channels more each
        return self.mix(seen)


class PyramidAttention(nn.Module):
    """TANet's pyramid sampling (PSA; Liu et al., AAAI 2020), with one output map instead of two stages.

    Three levels at strides 1, 2 and 4 are enlarged and joined (the coarse map). Every level is also joined with the
    other two, shrunk by maxima or enlarged by transposed convolutions, mixed back to its own width, enlarged, and added
    to the level above it (the refined map). Both maps are added and reduced to ``width`` channels.
    """

    def __init__(self, in_channels: int, width: int = 128, depths: tuple[int, int, int] = (3, 5, 5)) -> None:
        super().__init__()
        widths = (width, width, 2 * width)
        inputs = (in_channels, *widths[:2])
        self.stages = nn.ModuleList(
            nn.Sequential(conv_bn_relu(c, w, stride=stride), *(conv_bn_relu(w, w) for _ in range(depth)))
            for c, w, stride, depth in zip(inputs, widths, (1, 2, 2), depths)
        )
        self.coarse = nn.ModuleList(deconv_bn_relu(w, width, 2**i, 2**i) for i, w in enumerate(widths))
        # to level i from the coarser level j
        self.from_coarser = nn.ModuleDict(
            {f"{j}to{i}": deconv_bn_relu(widths[j], widths[j], 2 ** (j - i), 2 ** (j - i)) for i, j in COARSER}
        )
        self.mix = nn.ModuleList(conv_bn_relu(sum(widths), w, kernel=1) for w in widths)
        self.refine = nn.ModuleList(deconv_bn_relu(w, width, 2**i, 2**i) for i, w in enumerate(widths))
        self.reduce = conv_bn_relu(3 * width, width, kernel=1)
        self.out_channels = width

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, width, Y, X)``."""
        levels = []
        for stage in self.stages:
            bev = stage(bev)
            levels.append(bev)  # (B, width or 2 width, Y / 2^i, X / 2^i)
        fine = levels[0]
        coarse = [cut(up(level), fine) for up, level in zip(self.coarse, levels)]  # each (B, width, Y, X)
        mixed = [mix(torch.cat([self.seen_from(i, j, levels) for j in range(3)], 1)) for i, mix in enumerate(self.mix)]
        refined = [cut(up(level), fine) for up, level in zip(self.refine, mixed)]  # each (B, width, Y, X)
        refined[1] = refined[1] + refined[2]
        refined[0] = refined[0] + refined[1]
        return self.reduce(torch.cat(coarse, dim=1) + torch.cat(refined, dim=1))

    def seen_from(self, i: int, j: int, levels: Sequence[Tensor]) -> Tensor:
        """Bring level ``j`` to the size of level ``i``."""
        if i == j:
            return levels[j]
        if i < j:
            return cut(self.from_coarser[f"{j}to{i}"](levels[j]), levels[i])
        return functional.max_pool2d(levels[j], 2 ** (i - j), ceil_mode=True)


COARSER = ((0, 1), (0, 2), (1, 2))


def cut(bev: Tensor, like: Tensor) -> Tensor:
    """Cut a map to the size of another (an odd size halved and doubled is one larger)."""
    return bev[..., : like.shape[-2], : like.shape[-1]]
