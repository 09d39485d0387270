"""Voxel RoI pooling and the head on top of it (Voxel R-CNN, sections 3.2 and 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_linear_bn_eval

from beambox.geometry.boxes import local_to_world
from beambox.geometry.constants import constant
from beambox.geometry.grid import VoxelGrid
from beambox.layers.roi import Rois
from beambox.ops.sparse_conv import SparseTensor
from beambox.ops.voxel_query import pooled, pooled_query, voxel_query

__all__ = ["PoolLevel", "RoiHead", "RoiPredictions", "VoxelRoiPool"]


@dataclass(frozen=True)
class PoolLevel:
    """How features of one stride are gathered around a region's grid points."""

    stride: int
    """Voxels across a cell of this level."""
    query_range: tuple[int, int, int]
    """Cells looked at on both sides (z, y, x)."""
    radius: float
    """Largest distance from grid point to cell centre, metres."""
    max_samples: int = 16
    """Cells gathered at most."""
    channels: int = 32
    """Width of the gathered features."""


class _Gather(nn.Module):
    """One level: features and offsets of the cells around each grid point, added, and the maximum kept.

    The published code writes these layers as 1 x 1 convolutions.
    """

    def __init__(self, in_channels: int, level: PoolLevel) -> None:
        super().__init__()
        self.level = level
        self.feature = nn.Linear(in_channels, level.channels, bias=False)
        self.feature_norm = nn.BatchNorm1d(level.channels)
        self.offset = nn.Linear(3, level.channels, bias=False)
        self.offset_norm = nn.BatchNorm1d(level.channels)
        self.out = nn.Linear(level.channels, level.channels, bias=False)
        self.out_norm = nn.BatchNorm1d(level.channels)
        for linear in (self.feature, self.offset, self.out):
            nn.init.kaiming_normal_(linear.weight)

    def fold(self) -> None:
        """Take the batch norms into the linear layers before them for good; training ends here."""
        for name in ("feature", "offset", "out"):
            norm = getattr(self, f"{name}_norm")
            if isinstance(norm, nn.BatchNorm1d):
                setattr(self, name, fuse_linear_bn_eval(getattr(self, name), norm))
                setattr(self, f"{name}_norm", nn.Identity())

    def forward(self, points: Tensor, cells: Tensor, cell_features: SparseTensor, grid: VoxelGrid) -> Tensor:
        """Describe ``(M, 3)`` points in cells ``(M, 4)`` of full resolution: ``(M, channels)``."""
        level, sites = self.level, cell_features.sites
        size = constant(grid.cell, points.device) * level.stride
        minimum = constant(grid.minimum, points.device)
        centers = (sites.indices[:, 1:].flip(1) + 0.5) * size + minimum  # (V, 3)
        own = torch.cat((cells[:, :1], torch.div(cells[:, 1:], level.stride, rounding_mode="floor")), dim=1)
        kind = self.feature.weight.dtype
        features = _normed(self.feature(cell_features.features.to(kind)), self.feature_norm)  # (V, C)
        where = (points, own, sites, centers, level.query_range, level.radius, level.max_samples)
        if self.is_fused(features):
            described = pooled_query(*where, features, self.offset.weight, self.offset.bias)  # (M, C)
        else:
            described = pooled(points, centers, voxel_query(*where), features, self.position)  # (M, C)
        return functional.relu(_normed(self.out(described), self.out_norm))

    def position(self, away: Tensor) -> Tensor:
        """Describe ways from point to voxel: ``(N, 3)`` to ``(N, channels)``."""
        return _normed(self.offset(away), self.offset_norm)

    def is_fused(self, features: Tensor) -> bool:
        """Tell whether search and pooling are one: folded, on a CPU, in float32."""
        return (
            self.offset.bias is not None
            and isinstance(self.offset_norm, nn.Identity)
            and features.device.type == "cpu"
            and features.dtype == torch.float32
            and not torch.is_autocast_enabled("cpu")
        )


def _normed(values: Tensor, norm: nn.Module) -> Tensor:
    """Normalise rows; by the running statistics where there are too few for statistics of their own."""
    if not isinstance(norm, nn.BatchNorm1d):  # folded
        return values
    training = norm.training and len(values) > 1
    if training:
        return norm(values)
    return functional.batch_norm(
        values, norm.running_mean, norm.running_var, norm.weight, norm.bias, training=False, eps=norm.eps
    )


class VoxelRoiPool(nn.Module):
    """Describe each region by features gathered at a lattice of points in it, from several levels."""

    def __init__(self, in_channels: Sequence[int], levels: Sequence[PoolLevel], grid_size: int = 6) -> None:
        super().__init__()
        self.grid_size = grid_size
        steps = [(i + 0.5) / grid_size - 0.5 for i in range(grid_size)]
        self.steps = tuple(product(steps, steps, steps))
        """Where the points of a region lie, in its sizes from its centre."""
        self.levels = nn.ModuleList(
            _Gather(channels, level) for channels, level in zip(in_channels, levels, strict=True)
        )
        self.out_channels = grid_size**3 * sum(level.channels for level in levels)

    def grid_points(self, boxes: Tensor) -> Tensor:
        """Return ``grid_size ** 3`` points in each box, evenly spread, z fastest: ``(R, 7)`` -> ``(R, G, 3)``."""
        local = constant(self.steps, boxes.device, torch.float32)  # (G, 3)
        return local_to_world(local * boxes[:, None, 3:6], boxes)

    def forward(self, rois: Rois, levels: Sequence[SparseTensor], grid: VoxelGrid) -> Tensor:
        """Pool the levels at the regions: ``(R, out_channels)``, grid point after grid point."""
        points = self.grid_points(rois.boxes.detach()).flatten(0, 1)  # (R * G, 3)
        minimum, size = constant(grid.minimum, points.device), constant(grid.cell, points.device)
        cell = torch.div(points - minimum, size, rounding_mode="floor").long().flip(1)  # (R * G, 3) z, y, x
        sample = rois.sample.repeat_interleave(self.grid_size**3)
        cells = torch.cat((sample[:, None], cell), dim=1)
        pooled = [gather(points, cells, level, grid) for gather, level in zip(self.levels, levels, strict=True)]
        return torch.cat(pooled, dim=1).reshape(len(rois.boxes), self.out_channels)


@dataclass(frozen=True)
class RoiPredictions:
    """What the second stage says of R regions."""

    cls: Tensor
    """``(R,)`` logits of the overlap score."""
    deltas: Tensor
    """``(R, 7)`` box deltas in the regions' frames."""


class RoiHead(nn.Module):
    """Two shared fully connected layers, and two for each of score and box."""

    def __init__(self, in_channels: int, width: int = 256, dropout: float = 0.3) -> None:
        super().__init__()
        self.shared = _connected(in_channels, width, dropout)
        self.cls_layers = _connected(width, width, dropout)
        self.cls = nn.Linear(width, 1)
        self.box_layers = _connected(width, width, dropout)
        self.box = nn.Linear(width, 7)
        nn.init.normal_(self.cls.weight, std=0.01)
        nn.init.normal_(self.box.weight, std=0.001)
        nn.init.zeros_(self.cls.bias)
        nn.init.zeros_(self.box.bias)

    def forward(self, pooled: Tensor) -> RoiPredictions:
        """Predict from ``(R, in_channels)`` pooled features."""
        if len(pooled) == 1 and self.training:  # batch statistics need two values: the region counts twice
            twice = self(pooled.expand(2, -1))
            return RoiPredictions(twice.cls[:1], twice.deltas[:1])
        shared = self.shared(pooled)  # (R, width)
        cls, box = self.cls_layers(shared), self.box_layers(shared)
        with torch.autocast(pooled.device.type, enabled=False):  # boxes to the millimetre: bfloat16 has three digits
            kind = self.cls.weight.dtype
            return RoiPredictions(self.cls(cls.to(kind))[:, 0], self.box(box.to(kind)))


def _connected(in_channels: int, width: int, dropout: float) -> nn.Sequential:
    layers = nn.Sequential(
        nn.Linear(in_channels, width, bias=False),
        nn.BatchNorm1d(width),
        nn.ReLU(),
        nn.Dropout(dropout),
        nn.Linear(width, width, bias=False),
        nn.BatchNorm1d(width),
        nn.ReLU(),
    )
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_normal_(layer.weight)
    return layers
