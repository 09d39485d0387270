"""Voxel density awareness: how crowded the surroundings of each voxel are, as a map (DenNet, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError
from beambox.layers.sparse import levels_left, sparse_block
from beambox.ops.ball_count import ball_count
from beambox.ops.ball_count.reference import TOLERANCE
from beambox.ops.sparse_conv import Sites, SparseTensor, linear_keys
from beambox.ops.voxelize import Voxels

__all__ = ["CountSet", "DensityBranch", "Normalisation", "count_points", "normalised", "patch_cells"]

VOXELS_AT_ONCE = 256  # bounds the memory of the distances to points


class CountSet(str, Enum):
    """What is counted around a voxel's centre."""

    VOXELS = "voxels"
    """Centres of the voxels that hold a point."""
    POINTS = "points"
    """Points kept in voxels."""


class Normalisation(str, Enum):
    """What a count n becomes; N is the number of voxels in a flat, fully occupied disc of the same radius."""

    LOG_SHARE = "log-share"
    """ln(1 + n) / ln(1 + N): of order 1, and not long-tailed."""
    LOG = "log"
    """ln(1 + n)."""
    SHARE = "share"
    """n / N."""
    RAW = "raw"
    """n."""


def patch_cells(radius: float, cell: Sequence[float]) -> float:
    """Return N, the area of a disc over that of a voxel seen from above."""
    return math.pi * radius * radius / (cell[0] * cell[1])


def normalised(count: Tensor, radius: float, cell: Sequence[float], how: Normalisation) -> Tensor:
    """Turn counts ``(V,)`` within a radius into float32 features ``(V,)``."""
    count, full = count.float(), patch_cells(radius, cell)
    if how is Normalisation.LOG_SHARE:
        return torch.log1p(count) / math.log1p(full)
    if how is Normalisation.LOG:
        return torch.log1p(count)
    return count / full if how is Normalisation.SHARE else count


def count_points(centres: Tensor, of_centre: Tensor, points: Tensor, of_point: Tensor, radius: float) -> Tensor:
    """Count the points of the same sample within a radius of each centre; exact, in float64.

    Args:
        centres: ``(V, 3)``.
        of_centre: ``(V,)`` int64 sample of each.
        points: ``(K, 3)``.
        of_point: ``(K,)`` int64 sample of each.
        radius: metres.

    Returns:
        ``(V,)`` int64.
    """
    count = torch.zeros(len(centres), dtype=torch.int64, device=centres.device)
    reach = radius + 1e-3
    for sample in of_centre.unique().tolist():
        rows = torch.nonzero(of_centre == sample)[:, 0]
        rows = rows[centres[rows, 0].argsort()]
        cloud = points[of_point == sample].double()
        cloud = cloud[cloud[:, 0].argsort()]
        x = cloud[:, 0].contiguous()
        for some in rows.split(VOXELS_AT_ONCE):  # neighbours in x, so only a strip of points can be near
            near = centres[some].double()
            edges = torch.stack((near[0, 0] - reach, near[-1, 0] + reach))
            first, last = torch.searchsorted(x, edges).tolist()
            squared = (near[:, None] - cloud[None, first:last]).square().sum(dim=2)  # (R, S)
            count[some] = (squared <= radius * radius + TOLERANCE).sum(dim=1)
    return count


class DensityBranch(nn.Module):
    """Count around every voxel at several radii, condense the counts by sparse convolutions, lay them onto the map.

    Three strided convolutions reach the resolution of :class:`beambox.layers.encoders.VoxelEncoder`'s map; they have
    its kernels, strides and paddings, so their kernel maps are found once for both.
    """

    def __init__(
        self,
        radii: Sequence[float] = (0.6, 1.8),
        depth: int = 16,
        count_set: CountSet = CountSet.VOXELS,
        normalisation: Normalisation = Normalisation.LOG_SHARE,
        max_count: int | None = None,
        own_points: int | None = None,
        collapse: bool = False,
    ) -> None:
        """Build the branch.

        Args:
            radii: metres, one channel each.
            depth: channels of each convolution.
            count_set: what is counted.
            normalisation: what becomes of a count.
            max_count: counts stop here, as in a ball query that gathers so many; None counts all.
            own_points: the most points a voxel keeps, to add a channel for those it has; None for no such channel.
            collapse: halve the height once more by a further convolution.
        """
        super().__init__()
        if not radii or min(radii) <= 0:
            raise BeamboxError(f"`radii` must name at least one length above 0, got {tuple(radii)}")
        if max_count is not None and max_count < 1:
            raise BeamboxError(f"`max_count` must be at least 1 (a voxel counts itself), or none; got {max_count}")
        self.radii = tuple(radii)
        self.count_set = count_set
        self.normalisation = normalisation
        self.max_count = max_count
        self.own_points = own_points
        self.depth = depth
        channels = len(self.radii) + (own_points is not None)
        layers = [
            sparse_block(channels, depth, 3, 2, (1, 1, 1)),
            sparse_block(depth, depth, 3, 2, (1, 1, 1)),
            sparse_block(depth, depth, 3, 2, (0, 1, 1)),
        ]
        if collapse:
            layers.append(sparse_block(depth, depth, (3, 1, 1), (2, 1, 1), 0))
        self.layers = nn.Sequential(*layers)

    def bev_channels(self, levels: int) -> int:
        """Return the map's channels for a grid of so many height levels: those left times ``depth``."""
        return self.depth * levels_left(self.layers, levels + 1)

    def forward(self, sites: Sites, voxels: Voxels) -> Tensor:
        """Return the density map ``(B, depth * Z / 8, Y / 8, X / 8)``.

        Args:
            sites: of the voxels, as the encoder sees them.
            voxels: the same voxels with their points.
        """
        features = self.features(sites, voxels).to(voxels.points.dtype)  # (V, radii)
        return self.layers(SparseTensor(features, sites)).to_bev()

    @torch.no_grad()
    def features(self, sites: Sites, voxels: Voxels) -> Tensor:
        """Return each voxel's densities ``(V, radii)``, and with ``own_points`` its own, in the order of ``sites``."""
        cell = voxels.grid.cell
        columns = [normalised(self.counts(sites, voxels, r), r, cell, self.normalisation) for r in self.radii]
        if self.own_points is not None:
            row = torch.searchsorted(sites.sorted_keys, linear_keys(voxels.index, sites.shape))
            own = torch.empty(len(sites), device=voxels.count.device)
            own[sites.order[row]] = torch.log1p(voxels.count.float()) / math.log1p(self.own_points)
            columns.append(own)
        return torch.stack(columns, dim=1)

    @torch.no_grad()
    def counts(self, sites: Sites, voxels: Voxels, radius: float) -> Tensor:
        """Return how many voxels or points lie within a radius of each voxel's centre, ``(V,)`` int64."""
        if self.count_set is CountSet.VOXELS:
            count = ball_count(sites.indices, voxels.grid.cell, radius)
        else:
            centres = voxels.grid.centre(sites.indices[:, 1:])
            of_point = voxels.index[voxels.voxel, 0]
            count = count_points(centres, sites.indices[:, 0], voxels.points[:, :3], of_point, radius)
        return count if self.max_count is None else count.clamp(max=self.max_count)
