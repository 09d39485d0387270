"""Attention over heights, channels and places: HCNet's fusion of pseudo images, CBAM and strip pooling."""

from __future__ import annotations

from enum import Enum

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, expect_shape
from beambox.layers.bev import BN_EPS, BN_MOMENTUM
from beambox.ops.scatter import scatter_bev
from beambox.ops.voxelize import Voxels

__all__ = [
    "AdaptiveAdjustment",
    "Cbam",
    "Gate",
    "HeightChannelFusion",
    "HeightChannelKind",
    "pillar_stacks",
    "pseudo_images",
]


class HeightChannelKind(str, Enum):
    """Which attention weighs the pseudo images before they are merged (HCNet, table 3)."""

    NONE = "none"
    """No weights: the plain maximum over the slices."""
    CHANNEL = "CA"
    """One weight a channel, the same in all slices."""
    HEIGHT = "HA"
    """One weight a slice, the same in all channels."""
    BOTH = "HCA"
    """A weight for each channel and slice: the product of the two attentions."""


class Gate(str, Enum):
    """What turns the adjustment module's convolutions into weights."""

    RELU = "relu"
    """ReLU of each convolution, then the sum: not bounded above (as published)."""
    SIGMOID = "sigmoid"
    """Sum of the convolutions, then one sigmoid: weights between 0 and 1."""


def pillar_stacks(features: Tensor, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Put the voxels that stand above each other side by side; only pillars that hold a voxel appear.

    Args:
        features: ``(V, C)`` one row a voxel.
        voxels: what they describe, on a grid of N height slices.

    Returns:
        ``(M, N, C)`` features of each occupied pillar, slices from the lowest up, zero where a slice is empty; and
        ``(M, 4)`` int64 (sample, 0, y, x) of the pillars.
    """
    if torch.compiler.is_exporting():
        return one_stack_a_voxel(features, voxels)
    nx, ny, slices = voxels.grid.size
    sample, z, y, x = voxels.index.unbind(dim=1)
    distinct, pillar = ((sample * ny + y) * nx + x).unique(return_inverse=True)  # (M,), (V,)
    channels = features.shape[1]
    flat = features.new_zeros(len(distinct) * slices, channels)
    stacks = flat.index_copy(0, pillar * slices + z, features).view(len(distinct), slices, channels)  # (M, N, C)
    rows = torch.div(distinct, nx, rounding_mode="floor")  # (M,) sample * ny + y
    of_sample = torch.div(rows, ny, rounding_mode="floor")
    return stacks, torch.stack((of_sample, torch.zeros_like(rows), rows % ny, distinct % nx), dim=1)


def one_stack_a_voxel(features: Tensor, voxels: Voxels) -> tuple[Tensor, Tensor]:
    """Do as :func:`pillar_stacks` in a graph whose sizes are known before its values: M is V, the number of voxels.

    The first voxel of each pillar holds the pillar's stack; the stacks of the others are zero.
    """
    nx, ny, slices = voxels.grid.size
    sample, z, y, x = voxels.index.unbind(dim=1)
    count, channels = features.shape
    cell = (sample * ny + y) * nx + x  # (V,)
    row = torch.arange(count, device=cell.device)
    first = cell.new_full((voxels.batch_size * ny * nx,), count).scatter_reduce(0, cell, row, "amin")
    pillar = first[cell]  # (V,) row of the pillar's first voxel
    place = (pillar * slices + z)[:, None].expand_as(features)
    stacks = features.new_zeros(count * slices, channels).scatter(0, place, features).view(count, slices, channels)
    return stacks, torch.stack((sample, torch.zeros_like(z), y, x), dim=1)


def pseudo_images(features: Tensor, voxels: Voxels) -> Tensor:
    """Lay each height slice onto its own image, zero elsewhere (HCNet, section 3.2): ``(B, C, H, W, N)``.

    At HCNet's published size this is 219 MB a sweep; the network uses :func:`pillar_stacks`.
    """
    nx, ny, slices = voxels.grid.size
    images = []
    for z in range(slices):
        in_slice = voxels.index[:, 1] == z
        image = scatter_bev(features[in_slice], voxels.index[in_slice], voxels.batch_size, (ny, nx))  # (B, C, H, W)
        images.append(image[..., None])
    return torch.cat(images, dim=-1)  # (B, C, H, W, N)


class HeightChannelFusion(nn.Module):
    """HCNet's HC block and attention-weighted block (sections 3.3 and 3.4): N pseudo images become one.

    Each pixel weighs its slices and channels by two small networks, of the maximum over channels (height attention)
    and of the maximum over slices (channel attention), two 1 x 1 convolutions each; the weighted slices are merged by
    their maximum. No pixel looks at another, and where all slices are empty the result is zero. So it is enough to
    compute occupied pillars, which is what calling the module does; :meth:`dense` computes every pixel as the paper
    writes it. Features must not be negative (they come from a ReLU), or empty slices would win the maximum in both.
    """

    def __init__(
        self, channels: int, slices: int, kind: HeightChannelKind, height_hidden: int = 4, channel_hidden: int = 16
    ) -> None:
        super().__init__()
        self.kind = kind
        self.slices = slices
        uses_height = kind in (HeightChannelKind.HEIGHT, HeightChannelKind.BOTH)
        uses_channel = kind in (HeightChannelKind.CHANNEL, HeightChannelKind.BOTH)
        self.height = two_pointwise(slices, height_hidden) if uses_height else None
        self.channel = two_pointwise(channels, channel_hidden) if uses_channel else None

    def forward(self, stacks: Tensor) -> Tensor:
        """Merge the slices of each pillar: ``(M, N, C)``, no value negative, to ``(M, C)``."""
        expect_shape("stacks", stacks, (None, self.slices, None))
        height = None if self.height is None else self.height(stacks.amax(dim=2))  # (M, N)
        channel = None if self.channel is None else self.channel(stacks.amax(dim=1))  # (M, C)
        if height is not None and channel is not None:
            weight = torch.sigmoid(height[:, :, None] * channel[:, None, :])  # (M, N, C)
        elif height is not None:
            weight = torch.sigmoid(height)[:, :, None]
        elif channel is not None:
            weight = torch.sigmoid(channel)[:, None, :]
        else:
            return stacks.amax(dim=1)
        return (weight * stacks).amax(dim=1)

    def dense(self, images: Tensor) -> Tensor:
        """Merge pseudo images ``(B, C, H, W, N)`` into ``(B, C, H, W)`` by equations 1 to 3, every pixel of them."""
        expect_shape("images", images, (None, None, None, None, self.slices))
        return (self.attention(images) * images).amax(dim=4)

    def attention(self, images: Tensor) -> Tensor:
        """Return the weights of equation 3, ``(B, C, H, W, N)``, each in [0.5, 1); 1 where the kind is none."""
        by_height = images.amax(dim=1)  # (B, H, W, N)
        by_channel = images.amax(dim=4).permute(0, 2, 3, 1)  # (B, H, W, C)
        height = torch.ones_like(by_height) if self.height is None else self.height(by_height)
        channel = torch.ones_like(by_channel) if self.channel is None else self.channel(by_channel)
        product = channel[..., :, None] @ height[..., None, :]  # (B, H, W, C, 1) x (B, H, W, 1, N)
        weight = torch.ones_like(product) if self.kind is HeightChannelKind.NONE else torch.sigmoid(product)
        return weight.permute(0, 3, 1, 2, 4)


def two_pointwise(width: int, hidden: int) -> nn.Sequential:
    """Two 1 x 1 convolutions with ReLU, on the last axis; the result is at least 0."""
    return nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, width), nn.ReLU())


class Cbam(nn.Module):
    """Weigh channels, then places (CBAM: Woo et al., ECCV 2018, section 3).

    The channel weights depend on means and maxima over the whole map, so the answer at a place depends on the region.
    """

    def __init__(self, channels: int, reduction: int = 16, kernel: int = 7) -> None:
        super().__init__()
        hidden = max(4, channels // reduction)  # a narrow map keeps a few, lest ReLU shut the only one
        self.channel = nn.Sequential(
            nn.Linear(channels, hidden, bias=False), nn.ReLU(), nn.Linear(hidden, channels, bias=False)
        )
        self.place = nn.Sequential(
            nn.Conv2d(2, 1, kernel, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(1, eps=BN_EPS, momentum=BN_MOMENTUM),
        )

    def forward(self, bev: Tensor) -> Tensor:
        """Return ``(B, C, Y, X)`` weighed, of the same shape."""
        mean, largest = bev.mean(dim=(2, 3)), bev.amax(dim=(2, 3))  # (B, C)
        bev = bev * torch.sigmoid(self.channel(mean) + self.channel(largest))[:, :, None, None]
        places = torch.cat((bev.mean(dim=1, keepdim=True), bev.amax(dim=1, keepdim=True)), dim=1)  # (B, 2, Y, X)
        return bev * torch.sigmoid(self.place(places))


class AdaptiveAdjustment(nn.Module):
    """HCNet's adaptive-adjustment module: weigh a map by what its rows and columns hold (equations 4 to 6).

    Rows and columns are averaged over the whole map, so the answer at a place depends on the region.
    """

    def __init__(self, channels: int, gate: Gate = Gate.RELU, kernel: int = 3) -> None:
        super().__init__()
        if kernel % 2 == 0:
            raise BeamboxError(f"`kernel` must be odd, so that rows and columns keep their number, got {kernel}")
        self.gate = gate
        self.rows = strip_conv(channels, (kernel, 1), gate)
        self.columns = strip_conv(channels, (1, kernel), gate)

    def forward(self, bev: Tensor) -> Tensor:
        """Return ``(B, C, Y, X)`` weighed, of the same shape."""
        rows = self.rows(bev.mean(dim=3, keepdim=True))  # (B, C, Y, 1), equation 4
        columns = self.columns(bev.mean(dim=2, keepdim=True))  # (B, C, 1, X), equation 5
        weight = rows + columns  # (B, C, Y, X)
        return bev * (torch.sigmoid(weight) if self.gate is Gate.SIGMOID else weight)  # equation 6


def strip_conv(channels: int, kernel: tuple[int, int], gate: Gate) -> nn.Sequential:
    """Convolution along a strip and batch norm; ReLU where it is the gate."""
    padding = (kernel[0] // 2, kernel[1] // 2)
    layers: list[nn.Module] = [
        nn.Conv2d(channels, channels, kernel, padding=padding, bias=False),
        nn.BatchNorm2d(channels, eps=BN_EPS, momentum=BN_MOMENTUM),
    ]
    return nn.Sequential(*layers, nn.ReLU()) if gate is Gate.RELU else nn.Sequential(*layers)
