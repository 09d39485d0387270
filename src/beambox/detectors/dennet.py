"""DenNet: density awareness and neighbourhood attention for LiDAR 3-D detection (Qian et al., Photonics 9:820, 2022).

Voxel R-CNN with two additions: how many voxels lie around each voxel is condensed into a second map beside the
encoder's (VDA, section 3.2), and each stage of the 2-D network ends in neighbourhood attention (NA) and coordinate
attention (CA, section 3.3). The second stage, its features and all losses are Voxel R-CNN's::

    points -> voxels -> mean -----> sparse 3-D encoder -> map 256 --+
                |                    |  |  |                        +- cat 336 -> 6 conv 64, NA, CA --+-> up x1 --+
                +--> counts within   |  |  |                        |         6 conv 128 /2, NA, CA <-+           |
                     |               |  |  |                        |                             +----> up x2 ---+
                     0.6, 1.8 m -> 3 sparse convolutions -> 80 -----+                                             |
                                     |  |  |                    proposals <- anchor head <--------- cat 256 ------+
                                     +--+--+--> voxel RoI pooling <-+
                                                        +--> RoI head -> refined boxes

Equation 2, lost in print, is NAT's: for pixel x at (i, j), its 7 x 7 window X and heads of depth d,

    ``NA(x) = softmax(x W_Q (X W_K)^T / sqrt(d) + B) X W_V``, B by the offset from pixel to neighbour.

The paper reports moderate 3-D AP R40 of 85.39 / 59.52 / 75.27 (car, pedestrian, cyclist) on KITTI's validation split
and 60.31 mAP on ONCE's. Weights trained on these by its recipe are not available to compare with.

Where the paper is silent or contradicts itself (``docs/dennet.md`` tells each at length):

* KITTI's range is missing: 0.15 m in 4 m leaves 128 channels, not the 256 it names; z from -3 to 3 m does
  (``KITTI_Z4`` is the other reading). Its Voxel R-CNN row fits voxels of 0.05 m (``KITTI_005``), not 0.1 m as printed;
* every stage of the 2-D network "starts with a 2x downsampled convolution": strides 1 and 2, as Voxel R-CNN's code;
* counted are centres of occupied voxels ("voxel-filtered point cloud") around such centres, the voxel itself included,
  without a limit, as ln(1 + n) / ln(1 + N), N voxels in a full disc; the paper names no normalisation (``count_set``,
  ``normalization``, ``max_count``, ``own_points``);
* "light 3-D sparse convolution, kernel 3, stride 2, depth 16": three layers, as one does not reach stride 8;
* the NA module's figure is lost: a NAT block (layer norms, MLP of ratio 3, 2 and 4 heads of 32);
* coordinate attention as published, with max(8, C / 32) hidden channels;
* no Voxel R-CNN for ONCE is public: anchors and thresholds of the public toolbox's ONCE configurations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor, nn
from torch.nn import functional

from beambox.checks import BeamboxError, choose_fields, chosen, expect_same_length, expect_shape
from beambox.detectors.second import KITTI_VOXELS, ONCE_VOXELS
from beambox.detectors.voxel_rcnn import (
    COARSE_POOLING,
    FINE_POOLING,
    TwoStage,
    VoxelRCNNConfig,
    VoxelRCNNPredictions,
)
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, ONCE_ANCHORS, AnchorClass
from beambox.layers.bev import (
    BN_EPS,
    BN_MOMENTUM,
    conv_bn_relu,
    deconv_bn_relu,
    enlarge_and_join,
    expect_levels_meet,
    mean_over,
)
from beambox.layers.encoders import mean_voxels
from beambox.layers.heads import PostProcess
from beambox.layers.roi import NmsConfig
from beambox.layers.roi_pool import PoolLevel
from beambox.layers.sparse import levels_left, sparse_block
from beambox.ops.ball_count import ball_counts
from beambox.ops.ball_count.reference import TOLERANCE
from beambox.ops.neighborhood import neighborhood_attention
from beambox.ops.sparse_conv import Sites, SparseTensor, linear_keys
from beambox.ops.voxelize import Voxels
from beambox.structures.batch import Batch
from beambox.structures.labels import Labels

__all__ = [
    "DENNET_VOXELS",
    "KITTI_005",
    "KITTI_Z4",
    "ONCE",
    "AttentionPosition",
    "AttentiveBackbone",
    "CoordinateAttention",
    "CountSet",
    "DenNet",
    "DenNetConfig",
    "DensityBranch",
    "NeighborhoodAttention",
    "NeighborhoodBlock",
    "Normalization",
    "count_points",
    "dennet",
    "normalized",
    "patch_cells",
]

DENNET_VOXELS = VoxelGrid((0.0, -40.0, -3.0), (70.4, 40.0, 3.0), (0.1, 0.1, 0.15))
"""704 x 800 x 40 voxels in front of the sensor (DenNet, section 4.1; range see the module)."""
VOXELS_AT_ONCE = 256  # bounds the memory of the distances to points


class CountSet(str, Enum):
    """What is counted around a voxel's centre."""

    VOXELS = "voxels"
    """Centres of the voxels that hold a point."""
    POINTS = "points"
    """Points kept in voxels."""


class Normalization(str, Enum):
    """What a count n becomes; N is the number of voxels in a flat, fully occupied disc of the same radius."""

    LOG_SHARE = "log-share"
    """ln(1 + n) / ln(1 + N): of order 1, and not long-tailed."""
    LOG = "log"
    """ln(1 + n)."""
    SHARE = "share"
    """n / N."""
    RAW = "raw"
    """n."""


class AttentionPosition(str, Enum):
    """Where neighbourhood attention stands in a stage of the 2-D network."""

    END = "end"
    """After the stage's last convolution."""
    MIDDLE = "middle"
    """After half of the stage's convolutions (the third of six)."""


@dataclass(frozen=True)
class DenNetConfig(VoxelRCNNConfig):
    """Everything that defines the network; the defaults are the published KITTI setting with three classes."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS
    """One anchor shape per class; also the classes and their order."""
    grid: VoxelGrid = DENNET_VOXELS
    """Region and voxel size in metres (DenNet, section 4.1)."""
    pooling: tuple[PoolLevel, ...] = COARSE_POOLING
    """Levels of voxel RoI pooling, of strides 2, 4 and 8 (not in the paper; reaches that cover the radii)."""
    vda: bool = True
    """Voxel density awareness (DenNet, section 3.2)."""
    radii: tuple[float, ...] = (0.6, 1.8)
    """Metres around a voxel's centre in which is counted (DenNet, section 4.1)."""
    density_depth: int = 16
    """Channels of the density branch's convolutions (DenNet, section 3.2.2)."""
    count_set: CountSet = CountSet.VOXELS
    """What is counted."""
    normalization: Normalization = Normalization.LOG_SHARE
    """What becomes of a count (not in the paper)."""
    max_count: int | None = None
    """Counts stop here, as those of a ball query that gathers so many; None counts all (not in the paper)."""
    own_points: bool = False
    """A further channel: the voxel's own points, as ln(1 + n) / ln(1 + max_points)."""
    density_collapse: bool = False
    """Halve the density branch's height once more, as the encoder's last layer does: 32 channels in place of 80."""
    na: bool = True
    """Neighbourhood attention (DenNet, section 3.3.1)."""
    na_window: int = 7
    """Edge length of the neighbourhood, cells of the map (DenNet, section 4.1)."""
    na_heads: tuple[int, ...] = (2, 4)
    """Heads in each stage (NAT's first two stages, of the same widths)."""
    na_mlp: bool = True
    """The block's second half, a multilayer perceptron (NAT; DenNet's figure is lost)."""
    na_ratio: int = 3
    """Its width over the map's (NAT, smallest variants)."""
    na_position: AttentionPosition = AttentionPosition.END
    """Where neighbourhood attention stands in a stage; coordinate attention always ends it."""
    ca: bool = True
    """Coordinate attention (DenNet, section 3.3.2)."""
    ca_reduction: int = 32
    """Channels over hidden channels, of which there are at least 8 (Hou et al. 2021)."""

    def __post_init__(self) -> None:
        choose_fields(self)
        super().__post_init__()
        expect_same_length(widths=len(self.widths), na_heads=len(self.na_heads))
        if self.na_window < 1 or self.na_window % 2 == 0:
            raise BeamboxError(f"`na_window` must be odd, so that it has a centre, got {self.na_window}")


KITTI_Z4 = DenNetConfig(grid=VoxelGrid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.1, 0.1, 0.15)))
"""KITTI with the usual 4 m of height, 27 voxels: 128 + 48 channels in the map."""
KITTI_005 = DenNetConfig(grid=KITTI_VOXELS, pooling=FINE_POOLING)
"""KITTI with the voxels that the paper's own Voxel R-CNN row fits."""
ONCE = DenNetConfig(
    anchors=ONCE_ANCHORS,
    grid=ONCE_VOXELS,
    max_voxels=60000,
    test_proposals=NmsConfig(1024, 100, 0.7),
    post=PostProcess(score_threshold=0.1, nms_iou=0.01),
)
"""ONCE, five classes, voxels of 0.1 x 0.1 x 0.2 m (DenNet, section 4.1)."""


class DenNet(TwoStage):
    """The network; see :class:`DenNetConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`VoxelRCNNPredictions`. With all three switches
    off it is Voxel R-CNN.
    """

    def __init__(self, config: DenNetConfig) -> None:
        super().__init__(config)
        levels = config.grid.shape[0]
        channels = self.encoder.bev_channels(levels)
        self.density = None
        if config.vda:
            self.density = DensityBranch(
                config.radii,
                config.density_depth,
                config.count_set,
                config.normalization,
                config.max_count,
                config.max_points if config.own_points else None,
                config.density_collapse,
            )
            channels += self.density.bev_channels(levels)
        self.backbone = AttentiveBackbone(channels, config)

    def forward(
        self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None
    ) -> VoxelRCNNPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size.

        With ``labels`` the second stage looks at regions drawn to learn from, without at the best proposals.
        """
        grid = self.config.grid if grid is None else grid
        points = self.voxels(batch, grid)
        voxels = mean_voxels(points, self.config.absolute_xy)  # (V, columns)
        stages = self.encoder(voxels)
        maps = stages.bev  # (B, 256, ny / 8, nx / 8)
        if self.density is not None:
            maps = torch.cat((maps, self.density(voxels.sites, points)), dim=1)  # (B, 256 + 80, ny / 8, nx / 8)
        bev = self.backbone(maps)  # (B, 256, ny / 8, nx / 8)
        first = self.head(bev, grid)
        rois, targets = self.regions(first, labels)  # R boxes
        pooled = self.roi_pool(rois, self.levels(stages), grid)  # (R, 6 * 6 * 6 * 96)
        refined = self.roi_head(pooled)
        return VoxelRCNNPredictions(first, rois, refined, targets)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps; neighbourhood attention has kernels of its own, which nothing can compile."""
        stages = [stage for stage in self.backbone.stages if isinstance(stage, AttentiveStage)]
        layers = [layer for stage in stages for layer in (*stage.convolutions, *stage.further)]
        attentions = [stage.ca for stage in stages if isinstance(stage.ca, CoordinateAttention)]
        return (*layers, *attentions, *self.backbone.ups)


def patch_cells(radius: float, cell: Sequence[float]) -> float:
    """Return N, the area of a disc over that of a voxel in BEV."""
    return math.pi * radius * radius / (cell[0] * cell[1])


def normalized(count: Tensor, radius: float, cell: Sequence[float], how: Normalization | str) -> Tensor:
    """Turn counts ``(V,)`` within a radius into float32 features ``(V,)``."""
    how = chosen("how", how, Normalization)
    count, full = count.float(), patch_cells(radius, cell)
    if how is Normalization.LOG_SHARE:
        return torch.log1p(count) / math.log1p(full)
    if how is Normalization.LOG:
        return torch.log1p(count)
    return count / full if how is Normalization.SHARE else count


def count_points(centers: Tensor, of_center: Tensor, points: Tensor, of_point: Tensor, radius: float) -> Tensor:
    """Count the points of the same sample within a radius of each centre; exact, in float64.

    Args:
        centers: ``(V, 3)``.
        of_center: ``(V,)`` int64 sample of each.
        points: ``(K, 3)``.
        of_point: ``(K,)`` int64 sample of each.
        radius: metres.

    Returns:
        ``(V,)`` int64.
    """
    count = torch.zeros(len(centers), dtype=torch.int64, device=centers.device)
    reach = radius + 1e-3
    for sample in of_center.unique().tolist():
        rows = torch.nonzero(of_center == sample)[:, 0]
        rows = rows[centers[rows, 0].argsort()]
        cloud = points[of_point == sample].double()
        cloud = cloud[cloud[:, 0].argsort()]
        x = cloud[:, 0].contiguous()
        for some in rows.split(VOXELS_AT_ONCE):  # neighbours in x, so only a strip of points can be near
            near = centers[some].double()
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
        count_set: CountSet | str = CountSet.VOXELS,
        normalization: Normalization | str = Normalization.LOG_SHARE,
        max_count: int | None = None,
        own_points: int | None = None,
        collapse: bool = False,
    ) -> None:
        """Build the branch.

        Args:
            radii: metres, one channel each.
            depth: channels of each convolution.
            count_set: what is counted.
            normalization: what becomes of a count.
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
        self.count_set = chosen("count_set", count_set, CountSet)
        self.normalization = chosen("normalization", normalization, Normalization)
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
        counts = self.counts(sites, voxels).unbind(dim=1)
        columns = [normalized(count, r, cell, self.normalization) for count, r in zip(counts, self.radii)]
        if self.own_points is not None:
            row = torch.searchsorted(sites.sorted_keys, linear_keys(voxels.index, sites.shape))
            own = torch.empty(len(sites), device=voxels.count.device)
            own[sites.order[row]] = torch.log1p(voxels.count.float()) / math.log1p(self.own_points)
            columns.append(own)
        return torch.stack(columns, dim=1)

    @torch.no_grad()
    def counts(self, sites: Sites, voxels: Voxels) -> Tensor:
        """Return how many voxels or points lie within each radius of each voxel's centre, ``(V, R)`` int64."""
        if self.count_set is CountSet.VOXELS:
            extent = (sites.batch_size, *sites.shape)
            count = ball_counts(sites.indices, voxels.grid.cell, self.radii, extent)
        else:
            centers = voxels.grid.center(sites.indices[:, 1:])
            points, of_point, sample = voxels.points[:, :3], voxels.index[voxels.voxel, 0], sites.indices[:, 0]
            count = [count_points(centers, sample, points, of_point, radius) for radius in self.radii]
            count = torch.stack(count, dim=1)
        return count if self.max_count is None else count.clamp(max=self.max_count)


class AttentiveBackbone(nn.Module):
    """Voxel R-CNN's 2-D network with both attentions in every stage (DenNet, section 3.3.2, figure 6)."""

    def __init__(self, in_channels: int, config: DenNetConfig) -> None:
        super().__init__()
        expect_levels_meet(config.strides, config.up_strides)
        inputs = (in_channels, *config.widths[:-1])
        self.stages = nn.ModuleList(AttentiveStage(inputs[i], config, i) for i in range(len(inputs)))
        self.ups = nn.ModuleList(
            deconv_bn_relu(width, up_width, up_stride, up_stride)
            for width, up_width, up_stride in zip(config.widths, config.up_widths, config.up_strides)
        )

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, 256, Y, X)``: stages downwards, all enlarged and joined."""
        levels = []
        for stage in self.stages:
            bev = stage(bev)  # (B, 64, Y, X), then (B, 128, Y / 2, X / 2)
            levels.append(bev)
        return enlarge_and_join(self.ups, levels)  # each (B, 128, Y, X)


class AttentiveStage(nn.Module):
    """One stage of figure 6: six convolutions, neighbourhood attention, coordinate attention."""

    def __init__(self, in_channels: int, config: DenNetConfig, stage: int) -> None:
        super().__init__()
        width, heads = config.widths[stage], config.na_heads[stage]
        layers = [conv_bn_relu(in_channels, width, stride=config.strides[stage])]
        layers += [conv_bn_relu(width, width) for _ in range(config.depths[stage])]
        middle = config.na and config.na_position is AttentionPosition.MIDDLE
        before = len(layers) // 2 if middle else len(layers)
        self.convolutions = nn.Sequential(*layers[:before])
        block = NeighborhoodBlock(width, heads, config.na_window, config.na_mlp, config.na_ratio) if config.na else None
        self.na = block or nn.Identity()
        self.further = nn.Sequential(*layers[before:])  # none, unless NA stands in the middle
        self.ca = CoordinateAttention(width, config.ca_reduction) if config.ca else nn.Identity()

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, C, Y / s, X / s)``."""
        bev = self.convolutions(bev)  # (B, C, Y / s, X / s)
        bev = self.na(bev)
        bev = self.further(bev)
        return self.ca(bev)


def names_since(config: DenNetConfig) -> dict[str, str]:
    """Return what the layers of a stage were called in 0.1.0, where a stage was a flat list, and are called now."""
    names: dict[str, str] = {}
    for i, depth in enumerate(config.depths):
        middle = config.na and config.na_position is AttentionPosition.MIDDLE
        before = (depth + 1) // 2 if middle else depth + 1
        now = [f"convolutions.{k}" for k in range(before)] + ["na"] * config.na
        now += [f"further.{k}" for k in range(depth + 1 - before)] + ["ca"] * config.ca
        names |= {f"backbone.stages.{i}.{k}.": f"backbone.stages.{i}.{name}." for k, name in enumerate(now)}
    return names


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


class CoordinateAttention(nn.Module):
    """Weigh ``(B, C, H, W)`` by two gates, one per channel and row and one per channel and column.

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
        rows = mean_over(bev, 3)  # (B, C, H, 1)
        columns = mean_over(bev, 2).transpose(2, 3)  # (B, C, W, 1)
        hidden = self.shared(torch.cat((rows, columns), dim=2))  # (B, m, H + W, 1)
        rows, columns = hidden.split((height, width), dim=2)
        by_row = torch.sigmoid(self.rows(rows))  # (B, C, H, 1)
        by_column = torch.sigmoid(self.columns(columns)).transpose(2, 3)  # (B, C, 1, W)
        return bev * by_row * by_column


def dennet(config: DenNetConfig | None = None) -> DenNet:
    """Build DenNet; without a configuration, the published KITTI one with three classes (7.9 M parameters)."""
    return DenNet(config or DenNetConfig())
