"""Scores of boxes from keypoints on their border and inside, one score map a keypoint (KAM; KASSD, section 3.5).

Order of the keypoints of m = 6, n = 5, d = 5, e = 4; number 30, the extra one, stands where the anchor stood::

    left                                              border, each point once, clockwise from the front-left corner:
    13 --14 --15 --16 --17 -- 0                         front edge, n points; right edge, m - 1 more;
     |                        |                         rear edge, n - 1 more; left edge, m - 2 more
    12   20   23   26   29    1    v                  inside, the inner corners of a lattice of d x e cells:
     |                        |    ^                    from the rear to the front, in each column from right to left
    11   19   22   25   28    2    |
     |                        |    |
    10   18   21   24   27    3    +---> u heading
     |                        |
     9 -- 8 -- 7 -- 6 -- 5 -- 4
    right
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, choose_fields
from beambox.geometry.boxes import rotate_z
from beambox.geometry.constants import constant
from beambox.geometry.grid import VoxelGrid
from beambox.layers.bev import conv_bn_relu

__all__ = ["ExtraPoint", "KeypointLayout", "KeypointScores", "map_coordinates", "sample_bilinear"]


class ExtraPoint(enum.Enum):
    """Which point joins the inner lattice."""

    ANCHOR = "anchor"
    """Where the anchor stood that gave the box (KASSD, section 4.5)."""
    CENTER = "center"
    """The box's centre (KASSD, figure 7)."""
    NONE = "none"
    """None."""


@dataclass(frozen=True)
class KeypointLayout:
    """Where the keypoints of a box lie; the defaults are KASSD's best row of table 6, 18 and 13 points."""

    m: int = 6
    """Points of each long edge, with both corners; 0 (with ``n``) leaves the border out."""
    n: int = 5
    """Points of each short edge, with both corners."""
    d: int = 5
    """Cells of the inner lattice along the length; 0 (with ``e``) leaves the inside out, the extra point with it."""
    e: int = 4
    """Cells of the inner lattice along the width."""
    extra_point: ExtraPoint = ExtraPoint.ANCHOR
    """Which point joins the inner ones."""

    def __post_init__(self) -> None:
        choose_fields(self)
        if (self.m, self.n) != (0, 0) and min(self.m, self.n) < 2:
            raise BeamboxError(f"`m` and `n` count both corners: at least 2 each, or 0 both, got {self.m} and {self.n}")
        if (self.d, self.e) != (0, 0) and min(self.d, self.e) < 1:
            raise BeamboxError(f"`d` and `e` must be at least 1 each, or 0 both, got {self.d} and {self.e}")
        if self.count == 0:
            raise BeamboxError("a layout without any keypoint gives no score; choose some, or switch `kam` off")

    @property
    def boundary(self) -> int:
        """Number of points on the border, ``2 (m + n) - 4``."""
        return 2 * (self.m + self.n) - 4 if self.m else 0

    @property
    def inner(self) -> int:
        """Number of points inside, ``(d - 1)(e - 1)`` and the extra one."""
        return (self.d - 1) * (self.e - 1) + (self.extra_point is not ExtraPoint.NONE) if self.d else 0

    @property
    def count(self) -> int:
        """Number of keypoints, and of score maps."""
        return self.boundary + self.inner

    def unit(self) -> Tensor:
        """Positions in a box of length and width 1: ``(count, 2)`` float64 u (forward), v (left), in [-1/2, 1/2].

        An anchor is not fixed in the box: its row, the last, holds zeros.
        """
        return torch.tensor(_places(self), dtype=torch.float64)

    def _unit(self) -> list[tuple[float, float]]:
        """Compute :meth:`unit` without tensors, whose values are not known while a graph is traced."""
        points: list[tuple[float, float]] = []
        if self.m:
            along, across = _falling(self.m), _falling(self.n)
            points += [(0.5, v) for v in across]
            points += [(u, -0.5) for u in along[1:]]
            points += [(-0.5, -v) for v in across[1:]]
            points += [(-u, 0.5) for u in along[1:-1]]
        points += [(i / self.d - 0.5, j / self.e - 0.5) for i in range(1, self.d) for j in range(1, self.e)]
        if self.d and self.extra_point is not ExtraPoint.NONE:
            points.append((0.0, 0.0))
        return points

    def points(self, boxes: Tensor, anchors: Tensor) -> Tensor:
        """Place the keypoints of boxes, in BEV (KASSD, equation 3, corrected; see ``docs/kassd.md``).

        Args:
            boxes: ``(N, 7)``; gradients flow to centres, sizes and yaw.
            anchors: ``(N, 2)`` x, y of the anchors the boxes come from; used only by ``extra_point`` anchor.

        Returns:
            ``(N, count, 2)`` x, y in metres.
        """
        unit = constant(_places(self), boxes.device, boxes.dtype)  # (K, 2)
        local = unit * boxes[:, None, 3:5]  # (N, K, 2)
        placed = rotate_z(local, boxes[:, None, 6]) + boxes[:, None, :2]
        if self.d and self.extra_point is ExtraPoint.ANCHOR:
            placed = torch.cat((placed[:, :-1], anchors[:, None].to(boxes)), dim=1)
        return placed


@cache
def _places(layout: KeypointLayout) -> tuple[tuple[float, ...], ...]:
    """Return what :meth:`KeypointLayout.unit` does, as numbers."""
    return tuple(layout._unit())


def _falling(count: int) -> list[float]:
    """Return numbers from 1/2 down to -1/2 at equal steps, symmetric to the last digit."""
    upper = [0.5 - i / (count - 1) for i in range((count + 1) // 2)]
    return [*upper, *(-value for value in reversed(upper[: count // 2]))]


def map_coordinates(points: Tensor, grid: VoxelGrid, stride: int) -> Tensor:
    """Carry ``(..., 2)`` positions in metres to columns and rows of a map over ``grid`` (KASSD's rho, equation 4).

    Column 0 lies on the region's border, not half a cell inside: a strided 3 x 3 convolution with padding 1 looks
    around the first voxel of its cell.
    """
    low, cell = (constant(values[:2], points.device, points.dtype) for values in (grid.minimum, grid.cell))
    return (points - low) / (cell * stride)


def sample_bilinear(maps: Tensor, sample: Tensor, channel: Tensor, at: Tensor) -> Tensor:
    """Read maps between their cells (KASSD's zeta, equation 4); cells are points at whole numbers, zero outside.

    Args:
        maps: ``(B, C, Y, X)``.
        sample: which sample, int64, broadcastable to ``channel``.
        channel: ``(...)`` int64, which map.
        at: ``(..., 2)`` column and row, in cells.

    Returns:
        ``(...)``; differentiable with respect to ``maps`` and ``at``.
    """
    _, channels, height, width = maps.shape
    limit = constant((width, height), at.device, at.dtype)
    at = torch.minimum(at.clamp(min=-2.0), limit + 1.0)  # far outside is outside; keeps the index within int64
    corner = torch.floor(at).long()  # (..., 2)
    share = at - corner
    flat = maps.reshape(-1)
    plane = (sample * channels + channel) * (height * width)
    total = at.new_zeros(()).to(torch.promote_types(at.dtype, maps.dtype))
    for down in (0, 1):
        for right in (0, 1):
            x, y = corner[..., 0] + right, corner[..., 1] + down
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            across = share[..., 0] if right else 1 - share[..., 0]
            below = share[..., 1] if down else 1 - share[..., 1]
            value = flat[torch.where(inside, plane + y * width + x, 0)]
            total = total + torch.where(inside, across * below * value, 0.0)
    return total


class KeypointScores(nn.Module):
    """The keypoint-aware module (KAM): three convolutions give the score maps, boxes read them at their keypoints.

    Each class has its own maps, in the order (class, keypoint).
    """

    def __init__(
        self, in_channels: int, layout: KeypointLayout, stride: int, num_classes: int = 1, width: int = 128
    ) -> None:
        super().__init__()
        self.layout, self.stride = layout, stride
        self.maps = nn.Sequential(
            conv_bn_relu(in_channels, width),
            conv_bn_relu(width, width),
            nn.Conv2d(width, num_classes * layout.count, 1),
        )
        nn.init.normal_(self.maps[-1].weight, std=0.01)  # pyright: ignore[reportArgumentType]
        prior = 0.01  # as in the anchor head: a fresh network calls one box in a hundred good
        nn.init.constant_(self.maps[-1].bias, -math.log((1 - prior) / prior))  # pyright: ignore[reportArgumentType]

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, num_classes * count, Y, X)`` logits."""
        *hidden, last = self.maps
        for layer in hidden:
            bev = layer(bev)  # (B, width, Y, X)
        with torch.autocast(bev.device.type, enabled=False):  # scores are compared with each other: all their digits
            return last(bev.to(next(last.parameters()).dtype))

    def score(
        self, maps: Tensor, grid: VoxelGrid, sample: Tensor, boxes: Tensor, classes: Tensor, anchors: Tensor
    ) -> Tensor:
        """Score boxes: the mean of their keypoints' logits (KASSD, equation 5).

        Args:
            maps: of :meth:`forward`.
            grid: the region the maps cover.
            sample: ``(N,)`` int64 position of each box's sample in the batch.
            boxes: ``(N, 7)`` with resolved headings.
            classes: ``(N,)`` int64.
            anchors: ``(N, 2)`` x, y of the boxes' anchors.

        Returns:
            ``(N,)`` logits.
        """
        at = map_coordinates(self.layout.points(boxes, anchors), grid, self.stride)  # (N, K, 2)
        count = self.layout.count
        channel = classes[:, None] * count + torch.arange(count, device=maps.device)  # (N, K)
        return sample_bilinear(maps, sample[:, None], channel, at).mean(dim=1)
