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
  ``normalisation``, ``max_count``, ``own_points``);
* "light 3-D sparse convolution, kernel 3, stride 2, depth 16": three layers, as one does not reach stride 8;
* the NA module's figure is lost: a NAT block (layer norms, MLP of ratio 3, 2 and 4 heads of 32);
* coordinate attention as published, with max(8, C / 32) hidden channels;
* no Voxel R-CNN for ONCE is public: anchors and thresholds of the public toolbox's ONCE configurations.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
from torch import nn

from beambox.checks import BeamboxError, expect_same_length
from beambox.detectors.second import KITTI_VOXELS, ONCE_VOXELS
from beambox.detectors.voxel_rcnn import (
    COARSE_POOLING,
    FINE_POOLING,
    TwoStage,
    VoxelRcnnConfig,
    VoxelRcnnPredictions,
)
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, ONCE_ANCHORS, AnchorClass
from beambox.layers.bev import BevBackbone
from beambox.layers.coordinate_attention import CoordinateAttention
from beambox.layers.density import CountSet, DensityBranch, Normalisation
from beambox.layers.encoders import mean_voxels
from beambox.layers.heads import PostProcess
from beambox.layers.neighborhood_block import NeighborhoodBlock
from beambox.layers.roi import ProposalLimits
from beambox.layers.roi_pool import PoolLevel
from beambox.structures.batch import Batch

__all__ = [
    "DENNET_VOXELS",
    "KITTI_005",
    "KITTI_Z4",
    "ONCE",
    "AttentionPosition",
    "AttentiveBackbone",
    "DenNet",
    "DenNetConfig",
    "dennet",
]

DENNET_VOXELS = VoxelGrid((0.0, -40.0, -3.0), (70.4, 40.0, 3.0), (0.1, 0.1, 0.15))
"""704 x 800 x 40 voxels in front of the sensor (DenNet, section 4.1; range see the module)."""


class AttentionPosition(str, Enum):
    """Where neighbourhood attention stands in a stage of the 2-D network."""

    END = "end"
    """After the stage's last convolution."""
    MIDDLE = "middle"
    """After half of the stage's convolutions (the third of six)."""


@dataclass(frozen=True)
class DenNetConfig(VoxelRcnnConfig):
    """Everything that defines the network; the defaults are the published KITTI setting with three classes."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS
    """One anchor shape a class; also the classes and their order."""
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
    normalisation: Normalisation = Normalisation.LOG_SHARE
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
    test_proposals=ProposalLimits(1024, 100, 0.7),
    post=PostProcess(score_threshold=0.1, nms_iou=0.01),
)
"""ONCE, five classes, voxels of 0.1 x 0.1 x 0.2 m (DenNet, section 4.1)."""


class DenNet(TwoStage):
    """The network; see :class:`DenNetConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`VoxelRcnnPredictions`. With all three switches
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
                config.normalisation,
                config.max_count,
                config.max_points if config.own_points else None,
                config.density_collapse,
            )
            channels += self.density.bev_channels(levels)
        self.backbone = AttentiveBackbone(channels, config)

    def forward(self, batch: Batch, grid: VoxelGrid | None = None) -> VoxelRcnnPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size."""
        grid = self.config.grid if grid is None else grid
        points = self.voxels(batch, grid)
        voxels = mean_voxels(points, self.config.absolute_xy)  # (V, columns)
        stages = self.encoder(voxels)
        maps = stages.bev  # (B, 256, ny / 8, nx / 8)
        if self.density is not None:
            maps = torch.cat((maps, self.density(voxels.sites, points)), dim=1)  # (B, 256 + 80, ny / 8, nx / 8)
        bev = self.backbone(maps)  # (B, 256, ny / 8, nx / 8)
        return self.detect(stages, bev, grid)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps; neighbourhood attention has kernels of its own, which nothing can compile."""
        layers = [layer for stage in self.backbone.stages for layer in stage.children()]
        return (*(layer for layer in layers if not isinstance(layer, NeighborhoodBlock)), *self.backbone.ups)


class AttentiveBackbone(BevBackbone):
    """Voxel R-CNN's 2-D network with both attentions in every stage (DenNet, section 3.3.2, figure 6).

    ==========  ==================================================================================
    stage       layers
    ==========  ==================================================================================
    1           6 convolutions 3 x 3 of 64 channels, NA of 64, CA of 64
    2           6 convolutions 3 x 3 of 128 channels, the first of stride 2, NA of 128, CA of 128
    3           both enlarged to 128 channels at the size of the first, joined
    ==========  ==================================================================================
    """

    def __init__(self, in_channels: int, config: DenNetConfig) -> None:
        super().__init__(in_channels, config.depths, config.strides, config.widths, config.up_strides, config.up_widths)
        for i, (width, heads) in enumerate(zip(config.widths, config.na_heads)):
            layers = list(self.stages[i].children())
            if config.na:
                at = len(layers) // 2 if config.na_position is AttentionPosition.MIDDLE else len(layers)
                block = NeighborhoodBlock(width, heads, config.na_window, config.na_mlp, config.na_ratio)
                layers.insert(at, block)
            if config.ca:
                layers.append(CoordinateAttention(width, config.ca_reduction))
            self.stages[i] = nn.Sequential(*layers)


def dennet(config: DenNetConfig | None = None) -> DenNet:
    """Build DenNet; without a configuration, the published KITTI one with three classes (7.9 M parameters)."""
    return DenNet(config or DenNetConfig())
