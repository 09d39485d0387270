"""Voxel R-CNN: towards high performance voxel-based 3D object detection (Deng et al., AAAI 2021).

The first stage is SECOND with a narrower BEV backbone; the second gathers the sparse encoder's features around a
lattice of points in each proposed box and refines it::

    points -> voxels -> mean -> sparse 3-D encoder -> BEV map -> BEV backbone -> anchor head -> proposals
                                  |  |  stride 8                 256 ch          stride 8          |
                          stride 2|  |4 .. 8                                                       v
                                  +--+-----------------------------------------------> voxel RoI pooling -> RoI head
                                                                                       6 x 6 x 6 points     score, box

Configuration and numbers are those of the public toolbox's configuration for cars (OpenPCDet, ``voxel_rcnn_car.yaml``),
whose outputs, of both stages, are reproduced in evaluation mode from its checkpoints.

Deviations: features come from strides 2, 4 and 8 with one radius each, as in the toolbox (the paper's own code: strides
4 and 8 with two radii each); proposals are not padded (on a GPU, with a mask); one limit of voxels holds in training
and at test (the toolbox keeps 16000 in training). The voxel query's range is (z, y, x); for voxels of 0.1 m it is
(2, 3, 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor, nn

from beambox.checks import BeamboxError, expect_same_length
from beambox.detectors.contract import detections_from, expect_made, targets_from
from beambox.detectors.second import KITTI_VOXELS, ONCE_VOXELS, STRIDE
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, ONCE_ANCHORS, AnchorClass, AnchorGrid
from beambox.layers.bev import BevBackbone
from beambox.layers.encoders import EncoderStages, VoxelEncoder, mean_voxels
from beambox.layers.heads import AnchorHead, AnchorPredictions, LossWeights, PostProcess, anchor_loss
from beambox.layers.roi import (
    NmsConfig,
    Rois,
    RoiSampling,
    RoiTargets,
    decode_rois,
    propose,
    roi_loss,
    sample_rois,
    select_rois,
)
from beambox.layers.roi_pool import PoolLevel, RoiHead, RoiPredictions, VoxelRoiPool
from beambox.ops.sparse_conv import SparseTensor
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = ["KITTI", "ONCE", "TwoStage", "VoxelRCNN", "VoxelRCNNConfig", "VoxelRCNNPredictions", "voxel_rcnn"]

FINE_POOLING = tuple(PoolLevel(stride, (4, 4, 4), radius) for stride, radius in ((2, 0.4), (4, 0.8), (8, 1.6)))
"""Voxel RoI pooling for voxels of 0.05 m (toolbox)."""
COARSE_POOLING = tuple(PoolLevel(stride, (2, 3, 3), radius) for stride, radius in ((2, 0.4), (4, 0.8), (8, 1.6)))
"""Voxel RoI pooling for voxels of 0.1 m."""


@dataclass(frozen=True)
class VoxelRCNNConfig:
    """Everything that defines the network; the defaults are the published KITTI setting for cars."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS[:1]
    """One anchor shape per class; also the classes and their order."""
    grid: VoxelGrid = KITTI_VOXELS
    """Region and voxel size in metres (Voxel R-CNN, section 4.1)."""
    max_points: int = 5
    """Points kept in a voxel, in scan order (toolbox)."""
    max_voxels: int | None = 40000
    """Voxels kept in a sweep, in order of first appearance; None keeps all (toolbox, at test)."""
    num_point_features: int = 4
    """Values of a point: x, y, z, intensity, ..."""
    absolute_xy: bool = True
    """Whether a voxel's mean x and y are told from the sensor; else from the voxel's centre."""
    encoder_widths: tuple[int, int, int, int] = (16, 32, 64, 64)
    """Channels of the sparse encoder's stages (Voxel R-CNN, section 3.3)."""
    encoder_out: int = 128
    """Channels of one height level of the map (toolbox)."""
    depths: tuple[int, ...] = (5, 5)
    """Convolutions of each BEV stage after its first (Voxel R-CNN, section 3.3)."""
    strides: tuple[int, ...] = (1, 2)
    """Stride of each BEV stage's first convolution."""
    widths: tuple[int, ...] = (64, 128)
    """Channels of each BEV stage."""
    up_strides: tuple[int, ...] = (1, 2)
    """Enlargement of each BEV stage's output, to the size of the first."""
    up_widths: tuple[int, ...] = (128, 128)
    """Channels of each enlarged output."""
    centered_anchors: bool = False
    """Whether anchors stand at the centres of the map's cells."""
    loss: LossWeights = field(default_factory=LossWeights)
    """Weights of the first stage's losses; those of the second weigh 1."""
    smooth_l1_beta: float = 1 / 9
    """Where the first stage's regression loss turns linear (toolbox)."""
    train_proposals: NmsConfig = field(default_factory=lambda: NmsConfig(9000, 512, 0.8))
    """Proposals in training (Voxel R-CNN, section 4.1; toolbox)."""
    test_proposals: NmsConfig = field(default_factory=lambda: NmsConfig(2048, 100, 0.7))
    """Proposals at test (Voxel R-CNN, section 4.1; toolbox)."""
    sampling: RoiSampling = field(default_factory=RoiSampling)
    """Regions that the second stage learns from (Voxel R-CNN, section 3.4)."""
    pooling: tuple[PoolLevel, ...] = FINE_POOLING
    """Levels of voxel RoI pooling, of strides 2, 4 and 8."""
    grid_size: int = 6
    """Grid points along each edge of a region (Voxel R-CNN, section 4.1)."""
    roi_width: int = 256
    """Width of the second stage's fully connected layers (toolbox)."""
    dropout: float = 0.3
    """Share of values dropped in the second stage in training (toolbox)."""
    post: PostProcess = field(default_factory=lambda: PostProcess(score_threshold=0.3, nms_iou=0.1))
    """Post-processing at test time (toolbox; the paper: overlap up to 0.1)."""

    def __post_init__(self) -> None:
        if not self.anchors:
            raise BeamboxError("`anchors` must name at least one class, got none")
        strides = [level.stride for level in self.pooling]
        if not strides or not {2, 4, 8}.issuperset(strides):
            raise BeamboxError(f"`pooling` must name levels of stride 2, 4 or 8, got strides {strides}")
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


KITTI = VoxelRCNNConfig(anchors=KITTI_ANCHORS)
"""KITTI, three classes."""
ONCE = VoxelRCNNConfig(
    anchors=ONCE_ANCHORS,
    grid=ONCE_VOXELS,
    max_voxels=60000,
    test_proposals=NmsConfig(1024, 100, 0.7),
    pooling=COARSE_POOLING,
    post=PostProcess(score_threshold=0.1, nms_iou=0.01),
)
"""ONCE, five classes: no public configuration; thresholds of the toolbox's PV-RCNN on ONCE."""


@dataclass(frozen=True)
class VoxelRCNNPredictions:
    """Outputs of both stages."""

    first: AnchorPredictions
    """The first stage's anchors."""
    rois: Rois
    """What the second stage looked at: the first stage's best boxes or, given labels, those drawn to learn from."""
    refined: RoiPredictions
    """What it says of them."""
    targets: RoiTargets | None
    """What it is to learn of them; None without labels."""


class TwoStage(nn.Module):
    """What Voxel R-CNN shares with its successors: all but the 2-D network and what feeds it."""

    def __init__(self, config: VoxelRCNNConfig) -> None:
        super().__init__()
        self.config = config
        self.anchors = AnchorGrid(config.anchors, config.grid, STRIDE * config.strides[0], config.centered_anchors)
        self.encoder = VoxelEncoder(config.num_point_features, config.encoder_widths, config.encoder_out)
        self.head = AnchorHead(sum(config.up_widths), self.anchors)
        channels: dict[int, int] = dict(zip((2, 4, 8), self.encoder.stage_channels))
        self.roi_pool = VoxelRoiPool(
            [channels[level.stride] for level in config.pooling], config.pooling, config.grid_size
        )
        self.roi_head = RoiHead(self.roi_pool.out_channels, config.roi_width, config.dropout)

    def regions(self, first: AnchorPredictions, labels: Sequence[Labels] | None) -> tuple[Rois, RoiTargets | None]:
        """Choose what the second stage looks at; no gradient.

        Without labels: the first stage's best boxes, and no targets. With labels: regions drawn from more of its boxes
        as :class:`RoiSampling` says, by PyTorch's default source of randomness, and what they teach.
        """
        config = self.config
        if labels is None:
            return propose(first, config.test_proposals), None
        boxes, classes = targets_from(labels, config.classes, first.cls.device)
        targets = sample_rois(propose(first, config.train_proposals), boxes, classes, config.sampling)
        return targets.rois, targets

    def levels(self, stages: EncoderStages) -> list[SparseTensor]:
        """Return the encoder's features that the second stage pools, one for each level of the pooling."""
        by_stride = {2: stages.stride2, 4: stages.stride4, 8: stages.stride8}
        return [by_stride[level.stride] for level in self.config.pooling]

    def voxels(self, batch: Batch, grid: VoxelGrid) -> Voxels:
        """Gather points into voxels."""
        config = self.config
        points = batch.points[:, : config.num_point_features]
        return voxelize(points, batch.sample, batch.size, grid, config.max_points, config.max_voxels)

    def loss(self, predictions: VoxelRCNNPredictions, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return the first stage's weighted losses and the second's ``roi_cls``, ``roi_box`` and ``roi_corner``.

        Args:
            predictions: of this network, made with the same labels.
            labels: ground truth of each sample; objects of other classes are background.
        """
        expect_made(predictions.targets is not None, wanted=True)
        assert predictions.targets is not None
        first, refined = predictions.first, predictions.refined
        boxes, classes = targets_from(labels, self.config.classes, first.cls.device)
        losses = anchor_loss(first, boxes, classes, self.anchors, self.config.loss, self.config.smooth_l1_beta)
        return {**losses, **roi_loss(refined.cls, refined.deltas, predictions.targets)}

    def decode(self, predictions: VoxelRCNNPredictions) -> list[Detections]:
        """Return the detections of each sample, best first."""
        expect_made(predictions.targets is not None, wanted=False)
        rois, refined = predictions.rois, predictions.refined
        boxes = decode_rois(refined.deltas.float(), rois.boxes)
        return detections_from(select_rois(rois, refined.cls, boxes, self.config.post), self.config.classes)


class VoxelRCNN(TwoStage):
    """The network; see :class:`VoxelRCNNConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`VoxelRCNNPredictions`.
    """

    def __init__(self, config: VoxelRCNNConfig) -> None:
        super().__init__(config)
        self.backbone = BevBackbone(
            self.encoder.bev_channels(config.grid.shape[0]),
            config.depths,
            config.strides,
            config.widths,
            config.up_strides,
            config.up_widths,
        )

    def forward(
        self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None
    ) -> VoxelRCNNPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size.

        With ``labels`` the second stage looks at regions drawn to learn from, without at the best proposals.
        """
        grid = self.config.grid if grid is None else grid
        voxels = mean_voxels(self.voxels(batch, grid), self.config.absolute_xy)  # (V, columns)
        stages = self.encoder(voxels)
        bev = self.backbone(stages.bev)  # (B, 256, ny / 8, nx / 8)
        first = self.head(bev, grid)
        rois, targets = self.regions(first, labels)  # R boxes
        pooled = self.roi_pool(rois, self.levels(stages), grid)  # (R, 6 * 6 * 6 * 96)
        refined = self.roi_head(pooled)
        return VoxelRCNNPredictions(first, rois, refined, targets)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps."""
        return (self.backbone,)


def voxel_rcnn(config: VoxelRCNNConfig | None = None) -> VoxelRCNN:
    """Build Voxel R-CNN; without a configuration, the published one for KITTI's cars (7.6 M parameters)."""
    return VoxelRCNN(config or VoxelRCNNConfig())
