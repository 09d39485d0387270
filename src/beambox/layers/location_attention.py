"""KASSD's lightweight location attention: reused features, and two maps weighed place by place (KASSD, section 3.4)."""

from __future__ import annotations

import enum

import torch
from torch import Tensor, nn

from beambox.layers.bev import conv_bn_relu, deconv_bn_relu

__all__ = ["FeatureReuse", "LamReduce", "LocationAttention", "location_attention"]


class LamReduce(enum.Enum):
    """How a place's channels become one number."""

    SUM = "sum"
    """KASSD, equation 1."""
    MEAN = "mean"
    """Softer weights, whatever the number of channels."""


def location_attention(high: Tensor, low: Tensor, reduce: LamReduce = LamReduce.SUM) -> Tensor:
    """Join two maps by a softmax over the pair at every place (LAM; KASSD, equations 1 and 2).

    ``(p0, p1) = softmax(sum_c high, sum_c low)``, output ``p0 * high + p1 * low``. It has no parameters.

    Args:
        high: ``(B, C, Y, X)`` features of the higher level (F3).
        low: ``(B, C, Y, X)`` features of the lower level (F4).
        reduce: from a place's channels to one number.

    Returns:
        ``(B, C, Y, X)``.
    """
    difference = (high - low).sum(dim=1, keepdim=True, dtype=torch.promote_types(high.dtype, torch.float32))
    if reduce is LamReduce.MEAN:
        difference = difference / high.shape[1]
    weight = torch.sigmoid(difference).to(high.dtype)  # (B, 1, Y, X), the softmax of a pair
    return low + weight * (high - low)


class FeatureReuse(nn.Module):
    """The feature reuse strategy (FRS; KASSD, section 3.4 and figure 5a).

    ::

        F0 = reduce(bev)                 1 x 1, c channels
        F1 = three(F0) + F0              3 convolutions 3 x 3
        F2 = down(F1)                    stride 2, then 2 convolutions; 2 c channels at half the size
        F3 = up_high(F2) + F1 + F0       the high level
        F4 = up_low(F2)  + F0            the low level

    Branch 2 of the figure is F0 added everywhere, branch 3 is F1 added to F3; ``reuse`` off leaves only F1 in F3.
    ``context`` works on F2, where KASSD's table 5 inserts other modules.
    """

    def __init__(
        self, in_channels: int, width: int = 128, reuse: bool = True, context: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.reuse = reuse
        self.out_channels = width
        self.reduce = conv_bn_relu(in_channels, width, kernel=1)
        self.three = nn.Sequential(*(conv_bn_relu(width, width) for _ in range(3)))
        self.down = nn.Sequential(
            conv_bn_relu(width, 2 * width, stride=2),
            conv_bn_relu(2 * width, 2 * width),
            conv_bn_relu(2 * width, 2 * width),
        )
        self.context = nn.Identity() if context is None else context
        self.up_high = deconv_bn_relu(2 * width, width, 3, 2, padding=1, output_padding=1)
        self.up_low = deconv_bn_relu(2 * width, width, 3, 2, padding=1, output_padding=1)

    def forward(self, bev: Tensor) -> tuple[Tensor, Tensor]:
        """Map ``(B, in_channels, Y, X)`` to the high and the low level, ``(B, width, Y, X)`` each."""
        height, width = bev.shape[-2:]
        f0 = self.reduce(bev)  # (B, c, Y, X)
        f1 = self.three(f0)  # (B, c, Y, X)
        f1 = f1 + f0 if self.reuse else f1
        f2 = self.context(self.down(f1))  # (B, 2 c, Y / 2, X / 2)
        high = self.up_high(f2)[..., :height, :width] + f1  # an odd size halved and doubled is one larger
        low = self.up_low(f2)[..., :height, :width]
        return (high + f0, low + f0) if self.reuse else (high, low)


class LocationAttention(nn.Module):
    """The lightweight location attention module (LLM): FRS, then LAM; ``lam`` off adds the two levels instead."""

    def __init__(
        self,
        in_channels: int,
        width: int = 128,
        reuse: bool = True,
        lam: bool = True,
        reduce: LamReduce = LamReduce.SUM,
        context: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.levels = FeatureReuse(in_channels, width, reuse, context)
        self.lam, self.reduce = lam, reduce
        self.out_channels = width

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, width, Y, X)``."""
        high, low = self.levels(bev)
        return location_attention(high, low, self.reduce) if self.lam else high + low
