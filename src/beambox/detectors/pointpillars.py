"""PointPillars: fast encoders for object detection from point clouds (Lang et al., CVPR 2019).

Points are gathered into vertical pillars, each pillar is described by a small PointNet, the pillars form an image, and
a 2-D convolutional network with anchors finds the boxes::

    points -> pillars -> PointNet -> pseudo image -> BEV backbone (3 stages) -> anchor head -> boxes
              0.16 m     10 -> 64    496 x 432        strides 2, 4, 8 -> 2       stride 2

Configuration and numbers are those of the public toolbox's KITTI configuration (OpenPCDet, ``pointpillar.yaml``), whose
outputs are reproduced in evaluation mode from its checkpoints.

Deviations, each switchable:

* batch-norm statistics of the pillar network are those of real points, without padding rows (``empty_slots``);
* ``centered_anchors`` puts anchors at the cells' centres, where the toolbox spreads them over the region's borders;
* ``absolute_xy`` off drops each point's absolute x and y, so that one network serves any region around the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor, nn

from beambox.checks import BeamboxError, expect_same_length
from beambox.detectors.contract import detections_from, targets_from
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, AnchorClass, AnchorGrid
from beambox.layers.bev import BevBackbone
from beambox.layers.heads import AnchorHead, AnchorPredictions, LossWeights, PostProcess, anchor_loss, select_boxes
from beambox.layers.pillars import PillarFeatures
from beambox.ops.scatter import scatter_bev
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = ["KITTI_PILLARS", "PointPillars", "PointPillarsConfig", "pointpillars"]


KITTI_PILLARS = VoxelGrid((0.0, -39.68, -3.0), (69.12, 39.68, 1.0), (0.16, 0.16, 4.0))
"""432 x 496 pillars in front of the sensor."""


@dataclass(frozen=True)
class PointPillarsConfig:
    """Everything that defines the network; the defaults are the published KITTI setting with three classes."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS
    """One anchor shape per class; also the classes and their order."""
    grid: VoxelGrid = KITTI_PILLARS
    """Region in metres and pillar size (PointPillars, section 3.1: 0.16 m; range of the car network)."""
    max_points: int = 32
    """Points kept in a pillar, in scan order."""
    max_voxels: int | None = 40000
    """Pillars kept in a sweep, in order of first appearance; None keeps all."""
    num_point_features: int = 4
    """Values of a point: x, y, z, intensity, ..."""
    voxel_channels: int = 64
    """Width of the pillar features."""
    absolute_xy: bool = True
    """Whether a point's absolute x and y are among its features."""
    empty_slots: bool = False
    """Whether unfilled places of a pillar count in the maximum, as in the toolbox."""
    depths: tuple[int, ...] = (3, 5, 5)
    """Convolutions of each stage after its first."""
    strides: tuple[int, ...] = (2, 2, 2)
    """Stride of each stage's first convolution."""
    widths: tuple[int, ...] = (64, 128, 256)
    """Channels of each stage."""
    up_strides: tuple[int, ...] = (1, 2, 4)
    """Enlargement of each stage's output, to the size of the first."""
    up_widths: tuple[int, ...] = (128, 128, 128)
    """Channels of each enlarged output."""
    centered_anchors: bool = False
    """Whether anchors stand at the centres of the map's cells."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses (PointPillars, equation 3: loc 2, cls 1, dir 0.2)."""
    smooth_l1_beta: float = 1 / 9
    """Where the regression loss turns linear."""
    post: PostProcess = field(default_factory=PostProcess)
    """Post-processing at test time."""

    def __post_init__(self) -> None:
        if not self.anchors:
            raise BeamboxError("`anchors` must name at least one class, got none")
        expect_same_length(
            depths=len(self.depths),
            strides=len(self.strides),
            widths=len(self.widths),
            up_strides=len(self.up_strides),
            up_widths=len(self.up_widths),
        )

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(anchor.name for anchor in self.anchors)


class PointPillars(nn.Module):
    """The network; see :class:`PointPillarsConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`AnchorPredictions` over the map of stride 2.
    """

    def __init__(self, config: PointPillarsConfig) -> None:
        super().__init__()
        self.config = config
        slots = config.max_points if config.empty_slots else None
        self.anchors = AnchorGrid(config.anchors, config.grid, config.strides[0], config.centered_anchors)
        self.pillar_net = PillarFeatures(config.voxel_channels, config.num_point_features, config.absolute_xy, slots)
        self.backbone = BevBackbone(
            config.voxel_channels, config.depths, config.strides, config.widths, config.up_strides, config.up_widths
        )
        self.head = AnchorHead(self.backbone.out_channels, self.anchors)

    def forward(
        self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None
    ) -> AnchorPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size.

        ``labels`` are for networks with a second step; they change nothing here.
        """
        return self.from_voxels(self.voxels(batch, self.config.grid if grid is None else grid))

    def from_voxels(self, pillars: Voxels) -> AnchorPredictions:
        """Predict from points that are already gathered into pillars."""
        features = self.pillar_net(pillars)  # (V, C)
        image = self.pseudo_image(features, pillars)  # (B, C, ny, nx)
        bev = self.backbone(image)  # (B, 3 * 128, ny / 2, nx / 2)
        return self.head(bev, pillars.grid)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps."""
        return (self.backbone,)

    def voxels(self, batch: Batch, grid: VoxelGrid) -> Voxels:
        """Gather points into pillars."""
        config = self.config
        points = batch.points[:, : config.num_point_features]
        return voxelize(points, batch.sample, batch.size, grid, config.max_points, config.max_voxels)

    @staticmethod
    def pseudo_image(features: Tensor, pillars: Voxels) -> Tensor:
        """Put each pillar's feature at its place in an image that is zero elsewhere."""
        nx, ny, _ = pillars.grid.size
        return scatter_bev(features, pillars.index, pillars.batch_size, (ny, nx))

    def loss(self, predictions: AnchorPredictions, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return the weighted losses ``cls``, ``loc`` and ``direction``; objects of other classes are background."""
        config = self.config
        boxes, classes = targets_from(labels, config.classes, predictions.cls.device)
        return anchor_loss(predictions, boxes, classes, self.anchors, config.loss, config.smooth_l1_beta)

    def decode(self, predictions: AnchorPredictions) -> list[Detections]:
        """Return the detections of each sample, best first."""
        return detections_from(select_boxes(predictions, self.config.post), self.config.classes)


def pointpillars(config: PointPillarsConfig | None = None) -> PointPillars:
    """Build PointPillars; without a configuration, the published KITTI one with three classes (4.8 M parameters)."""
    return PointPillars(config or PointPillarsConfig())
