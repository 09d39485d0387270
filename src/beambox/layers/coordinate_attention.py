"""Coordinate attention: weigh channels by row and by column (Hou, Zhou, Feng, CVPR 2021; DenNet, section 3.3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from beambox.checks import expect_shape
from beambox.layers.bev import BN_EPS, BN_MOMENTUM

__all__ = ["CoordinateAttention"]


class CoordinateAttention(nn.Module):
    """Weigh ``(B, C, H, W)`` by two gates, one a channel and row and one a channel and column.

    Rows and columns are averaged over the whole map, so the answer at a place depends on the region.
    """

    def __init__(self, channels: int, reduction: int = 32) -> None:
        super().__init__()
        self.channels = channels
        hidden = max(8, channels // reduction)
        self.shared = nn.Sequential(
            nn.Conv2d(channels, hidden, 1), nn.BatchNorm2d(hidden, eps=BN_EPS, momentum=BN_MOMENTUM), nn.Hardswish()
        )
        self.rows = nn.Conv2d(hidden, channels, 1)
        self.columns = nn.Conv2d(hidden, channels, 1)

    def forward(self, bev: Tensor) -> Tensor:
        """Return ``bev`` weighed, of the same shape."""
        expect_shape("bev", bev, (None, self.channels, None, None))
        height, width = bev.shape[-2:]
        rows = bev.mean(dim=3, keepdim=True)  # (B, C, H, 1)
        columns = bev.mean(dim=2, keepdim=True).transpose(2, 3)  # (B, C, W, 1)
        hidden = self.shared(torch.cat((rows, columns), dim=2))  # (B, m, H + W, 1)
        rows, columns = hidden.split((height, width), dim=2)
        by_row = torch.sigmoid(self.rows(rows))  # (B, C, H, 1)
        by_column = torch.sigmoid(self.columns(columns)).transpose(2, 3)  # (B, C, 1, W)
        return bev * by_row * by_column
