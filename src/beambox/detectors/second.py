"""SECOND: sparsely embedded convolutional detection (Yan, Mao, Li; Sensors 2018, 18, 3337).

Points are averaged in small voxels, sparse 3-D convolutions condense them into a bird's-eye-view map, and a 2-D
convolutional network with anchors finds the boxes::

    points -> voxels -> mean -> sparse 3-D encoder -> BEV map -> BEV backbone (2 stages) -> anchor head -> boxes
              0.05 m    4       stride 8               256 ch     strides 1, 2 -> 512 ch     stride 8

Configuration and numbers are those of the public toolbox's KITTI configuration (OpenPCDet, ``second.yaml``), whose
outputs are reproduced in evaluation mode from its checkpoints.

Deviations: voxels are described by their mean rather than by the paper's voxel feature layers, as in the toolbox; one
limit of voxels holds in training and at test (the toolbox keeps 16000 in training).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor, nn

from beambox.checks import BeamboxError, expect_same_length
from beambox.detectors.contract import detections_from, targets_from
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, ONCE_ANCHORS, AnchorClass, AnchorGrid
from beambox.layers.bev import BevBackbone
from beambox.layers.encoders import VoxelEncoder, mean_voxels
from beambox.layers.heads import AnchorHead, AnchorPredictions, LossWeights, PostProcess, anchor_loss, select_boxes
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = ["KITTI_CAR", "KITTI_VOXELS", "ONCE", "ONCE_VOXELS", "SECOND", "SECONDConfig", "second"]

STRIDE = 8
"""Voxels across one cell of the map."""
KITTI_VOXELS = VoxelGrid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.05, 0.05, 0.1))
"""1408 x 1600 x 40 voxels in front of the sensor."""
ONCE_VOXELS = VoxelGrid((-75.2, -75.2, -5.0), (75.2, 75.2, 3.0), (0.1, 0.1, 0.2))
"""1504 x 1504 x 40 voxels around the sensor."""


@dataclass(frozen=True)
class SECONDConfig:
    """Everything that defines the network; the defaults are the toolbox's KITTI setting with three classes."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS
    """One anchor shape per class; also the classes and their order."""
    grid: VoxelGrid = KITTI_VOXELS
    """Region and voxel size in metres (toolbox; the paper uses 0.2 x 0.05 x 0.05 and the same range)."""
    max_points: int = 5
    """Points kept in a voxel, in scan order (toolbox)."""
    max_voxels: int | None = 40000
    """Voxels kept in a sweep, in order of first appearance; None keeps all (toolbox, at test)."""
    num_point_features: int = 4
    """Values of a point: x, y, z, intensity, ..."""
    absolute_xy: bool = True
    """Whether a voxel's mean x and y are told from the sensor; else from the voxel's centre."""
    encoder_widths: tuple[int, int, int, int] = (16, 32, 64, 64)
    """Channels of the sparse encoder's stages (toolbox)."""
    encoder_out: int = 128
    """Channels of one height level of the map (toolbox)."""
    depths: tuple[int, ...] = (5, 5)
    """Convolutions of each BEV stage after its first (SECOND, section 3.1.3)."""
    strides: tuple[int, ...] = (1, 2)
    """Stride of each BEV stage's first convolution."""
    widths: tuple[int, ...] = (128, 256)
    """Channels of each BEV stage."""
    up_strides: tuple[int, ...] = (1, 2)
    """Enlargement of each BEV stage's output, to the size of the first."""
    up_widths: tuple[int, ...] = (256, 256)
    """Channels of each enlarged output."""
    centered_anchors: bool = False
    """Whether anchors stand at the centres of the map's cells."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses (SECOND, equation 8: cls 1, loc 2, dir 0.2)."""
    smooth_l1_beta: float = 1 / 9
    """Where the regression loss turns linear (toolbox)."""
    post: PostProcess = field(default_factory=PostProcess)
    """Post-processing at test time (toolbox: scores from 0.1, overlap up to 0.01)."""

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


KITTI_CAR = SECONDConfig(anchors=KITTI_ANCHORS[:1])
"""KITTI, cars only."""
ONCE = SECONDConfig(anchors=ONCE_ANCHORS, grid=ONCE_VOXELS, max_voxels=60000)
"""ONCE, five classes (toolbox, ``once_models/second.yaml``)."""


class SECOND(nn.Module):
    """The network; see :class:`SECONDConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`AnchorPredictions` over the map of stride 8.
    """

    def __init__(self, config: SECONDConfig) -> None:
        super().__init__()
        self.config = config
        self.anchors = AnchorGrid(config.anchors, config.grid, STRIDE * config.strides[0], config.centered_anchors)
        self.encoder = VoxelEncoder(config.num_point_features, config.encoder_widths, config.encoder_out)
        self.backbone = BevBackbone(
            self.encoder.bev_channels(config.grid.shape[0]),
            config.depths,
            config.strides,
            config.widths,
            config.up_strides,
            config.up_widths,
        )
        self.head = AnchorHead(self.backbone.out_channels, self.anchors)

    def forward(
        self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None
    ) -> AnchorPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size.

        ``labels`` are for networks with a second step; they change nothing here.
        """
        return self.from_voxels(self.voxels(batch, self.config.grid if grid is None else grid))

    def from_voxels(self, voxels: Voxels) -> AnchorPredictions:
        """Predict from points that are already gathered into voxels."""
        means = mean_voxels(voxels, self.config.absolute_xy)  # (V, columns)
        stages = self.encoder(means)
        bev = self.backbone(stages.bev)  # (B, 512, ny / 8, nx / 8)
        return self.head(bev, voxels.grid)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps."""
        return (self.backbone,)

    def voxels(self, batch: Batch, grid: VoxelGrid) -> Voxels:
        """Gather points into voxels."""
        config = self.config
        points = batch.points[:, : config.num_point_features]
        return voxelize(points, batch.sample, batch.size, grid, config.max_points, config.max_voxels)

    def loss(self, predictions: AnchorPredictions, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return the weighted losses ``cls``, ``loc`` and ``direction``; objects of other classes are background."""
        config = self.config
        boxes, classes = targets_from(labels, config.classes, predictions.cls.device)
        return anchor_loss(predictions, boxes, classes, self.anchors, config.loss, config.smooth_l1_beta)

    def decode(self, predictions: AnchorPredictions) -> list[Detections]:
        """Return the detections of each sample, best first."""
        return detections_from(select_boxes(predictions, self.config.post), self.config.classes)


def second(config: SECONDConfig | None = None) -> SECOND:
    """Build SECOND; without a configuration, the toolbox's KITTI one with three classes (5.3 M parameters)."""
    return SECOND(config or SECONDConfig())
