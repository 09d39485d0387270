"""Neighbourhood attention as a layer of a bird's-eye-view network (NAT, Hassani et al. 2023; DenNet, section 3.3.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.neighborhood import neighborhood_attention

__all__ = ["NeighborhoodAttention", "NeighborhoodBlock"]


class NeighborhoodAttention(nn.Module):
    """Let each pixel attend to the ``window`` x ``window`` pixels around it, in several heads."""

    def __init__(self, channels: int, heads: int, window: int = 7) -> None:
        super().__init__()
        if heads < 1 or channels % heads:
            raise BeamboxError(f"`heads` must divide the {channels} channels, got {heads}")
        self.heads = heads
        self.window = window
        self.qkv = nn.Linear(channels, 3 * channels)
        self.bias = nn.Parameter(torch.empty(heads, 2 * window - 1, 2 * window - 1))
        self.out = nn.Linear(channels, channels)
        nn.init.trunc_normal_(self.bias, std=0.02)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map ``(B, H, W, C)`` to the same shape; a map smaller than the window is padded with zeros meanwhile."""
        height, width, channels = pixels.shape[1:]
        below, beside = max(0, self.window - height), max(0, self.window - width)
        padded = functional.pad(pixels, (0, 0, 0, beside, 0, below)) if below or beside else pixels
        qkv = self.qkv(padded).unflatten(-1, (3, self.heads, channels // self.heads))  # (B, H, W, 3, heads, d)
        q, k, v = qkv.permute(3, 0, 4, 1, 2, 5).unbind(dim=0)  # each (B, heads, H, W, d)
        attended = neighborhood_attention(q, k, v, self.bias.to(q.dtype), self.window)
        attended = attended.permute(0, 2, 3, 1, 4).flatten(3)  # (B, H, W, C)
        return self.out(attended[:, :height, :width])


class NeighborhoodBlock(nn.Module):
    """A transformer block with neighbourhood attention: ``y = x + NA(LN(x))``, ``z = y + MLP(LN(y))``.

    The multilayer perceptron, ``ratio`` times as wide as the map, is optional.
    """

    def __init__(self, channels: int, heads: int, window: int = 7, mlp: bool = True, ratio: int = 3) -> None:
        super().__init__()
        self.channels = channels
        self.norm = nn.LayerNorm(channels)
        self.attention = NeighborhoodAttention(channels, heads, window)
        self.mlp = None
        if mlp:
            self.mlp = nn.Sequential(
                nn.LayerNorm(channels),
                nn.Linear(channels, ratio * channels),
                nn.GELU(),
                nn.Linear(ratio * channels, channels),
            )

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to the same shape."""
        expect_shape("bev", bev, (None, self.channels, None, None))
        pixels = bev.permute(0, 2, 3, 1)  # (B, H, W, C)
        pixels = pixels + self.attention(self.norm(pixels))
        pixels = pixels if self.mlp is None else pixels + self.mlp(pixels)
        return pixels.permute(0, 3, 1, 2)
