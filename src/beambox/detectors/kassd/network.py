"""KASSD: keypoint-aware single-stage 3D object detector (Xu et al., Sensors 22:1451, 2022).

SECOND with two changes. LLM, a lightweight module that keeps spatial features flowing (FRS) and weighs two levels place
by place (LAM), replaces its bird's-eye-view backbone. KAM scores each predicted box by what the maps say at keypoints
on its border and inside, rather than at the cell its anchor happens to stand in::

    points -> voxels -> sparse 3-D encoder -> BEV map -> LLM --+-> anchor head -> boxes --+
              0.05 m    stride 8              256 ch     128 ch |   sect. 3.6              v
                                              sect. 3.4        +-> KAM: 31 score maps -> keypoints -> scores -> NMS
                                                                   sect. 3.5

The paper reports, for cars on KITTI's validation split, 3-D AP 90.14 / 80.06 / 78.91 (easy / moderate / hard; 11
recalls). Weights trained on KITTI by its recipe are not available to compare with.

Where the paper is silent or contradicts itself (``docs/kassd.md`` tells each at length):

* equation 3 as printed puts keypoints beside the box (``l`` read as 1, a wrong sign, a sine for a cosine): corrected,
  and drawn in :mod:`beambox.detectors.kassd.keypoints`;
* 4, 18 and 28 border points are distinct points, ``2 (m + n) - 4``; the inner ones are the inner corners of the lattice
  and the anchor, although figure 7 draws the centre (``extra_point``);
* equation 4's index bounds overlap: the channels are numbered around the box, corners once;
* equation 1 is missing: a softmax over the sums of the two levels' channels;
* the levels of FRS, its "two deconvolutions" (parallel) and its sums are read from the text;
* what KAM learns from, and what becomes of its score, are not told: focal loss, a box is right from 3-D IoU 0.7 on, the
  score replaces the class score (``kam_options.score`` multiply keeps both);
* the loss weights (2, 1, 1, 0.2) are in the order class, box, keypoints, direction as printed; every relative of KASSD
  has class 1, box 2: ``swapped``;
* smooth-L1 turns linear at 1/9, as in SECOND's code, not at 1 as printed (``smooth_l1_beta``);
* learning rate, augmentation and post-processing are missing: those of SA-SSD, its nearest relative.

Added: several classes, each with its own score maps; ``neck`` for the paper's table 5; ``centred_anchors``.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError
from beambox.detectors.contract import detections_from, targets_from
from beambox.detectors.kassd.keypoints import KeypointLayout, KeypointScores
from beambox.detectors.kassd.necks import DenseAspp, PyramidAttention, SpatialPyramidPooling
from beambox.detectors.second import KITTI_VOXELS, STRIDE
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, AnchorClass, AnchorGrid
from beambox.layers.bev import BevBackbone, conv_bn_relu, deconv_bn_relu
from beambox.layers.encoders import VoxelEncoder, mean_voxels
from beambox.layers.heads import (
    AnchorHead,
    AnchorPredictions,
    LossWeights,
    PostProcess,
    anchor_loss,
    best_anchors,
    select_boxes,
)
from beambox.layers.losses import sigmoid_focal
from beambox.ops.nms import nms
from beambox.ops.rotated_iou import iou_3d
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = [
    "FeatureReuse",
    "KamOptions",
    "KamScore",
    "Kassd",
    "KassdConfig",
    "KassdPredictions",
    "LamReduce",
    "LocationAttention",
    "Neck",
    "kassd",
    "location_attention",
]


class Neck(enum.Enum):
    """From the encoder's map to the head's (table 5)."""

    LLM = "llm"
    """The paper's lightweight location attention module."""
    SECOND = "second"
    """SECOND's backbone, the paper's baseline: 5 + 5 convolutions, 512 channels out."""
    PSA = "psa"
    """TANet's pyramid sampling in place of the module."""
    DENSEASPP = "denseaspp"
    """The module with dense dilated convolutions at its lowest resolution."""
    SPP = "spp"
    """The module with spatial pyramid pooling at its lowest resolution."""


class LamReduce(enum.Enum):
    """How a place's channels become one number."""

    SUM = "sum"
    """KASSD, equation 1."""
    MEAN = "mean"
    """Softer weights, whatever the number of channels."""


class KamScore(enum.Enum):
    """What becomes of KAM's score at test time."""

    REPLACE = "replace"
    """It is the box's score."""
    MULTIPLY = "multiply"
    """It is multiplied by the class score."""


@dataclass(frozen=True)
class KamOptions:
    """Which boxes the keypoint-aware module looks at, and what is right."""

    threshold: float = 0.1
    """Class score from which a box is looked at, in training and at test time."""
    train_boxes: int = 4096
    """Boxes of a sample in training, the best; the labelled boxes come on top."""
    train_least: int = 100
    """Boxes of a sample in training where none reaches the threshold."""
    test_boxes: int = 2000
    """Boxes of a sample at test time, the best."""
    positive_iou: tuple[float, ...] = (0.7,)
    """3-D overlap with an object of its class from which a box is right: one for all classes, or one a class."""
    soft_targets: bool = False
    """Learn ``2 IoU - 0.5``, cut to [0, 1], instead of right or wrong."""
    box_gradient: bool = False
    """Whether the scores' loss also moves the boxes."""
    score: KamScore = KamScore.REPLACE
    """What becomes of the score at test time: replace or multiply the class score."""


@dataclass(frozen=True)
class KassdConfig:
    """Everything that defines the network; the defaults are the published KITTI setting, cars only."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS[:1]
    """One anchor shape a class; also the classes and their order (section 4.2)."""
    grid: VoxelGrid = KITTI_VOXELS
    """Region and voxel size in metres (section 4.2: 0.05 x 0.05 x 0.1)."""
    max_points: int = 5
    """Points kept in a voxel, in scan order."""
    max_voxels: int | None = 40000
    """Voxels kept in a sweep, in order of first appearance; None keeps all."""
    columns: int = 4
    """Values of a point: x, y, z, intensity, ..."""
    absolute_xy: bool = True
    """Whether a voxel's mean x and y are told from the sensor; else from the voxel's centre."""
    encoder_widths: tuple[int, int, int, int] = (16, 32, 64, 64)
    """Channels of the sparse encoder's stages."""
    encoder_out: int = 128
    """Channels of one height level of the map."""
    llm: bool = True
    """Whether the location attention module replaces SECOND's backbone (table 4); off equals ``neck`` second."""
    neck: Neck = Neck.LLM
    """What stands between encoder and head (table 5): llm, second, psa, denseaspp or spp."""
    width: int = 128
    """Channels c of the neck's full resolution; half resolution has 2 c."""
    frs_reuse: bool = True
    """Whether the first features are added to the later ones (branches 2 and 3 of figure 5a)."""
    lam: bool = True
    """Whether the two levels are weighed place by place (figure 5b); off adds them."""
    lam_reduce: LamReduce = LamReduce.SUM
    """From a place's channels to its weight: sum (equation 1) or mean."""
    kam: bool = True
    """Whether keypoints score the boxes (table 4)."""
    keypoints: KeypointLayout = field(default_factory=KeypointLayout)
    """Where the keypoints lie (table 6): m, n, d, e, extra_point."""
    kam_width: int = 128
    """Channels of the first two convolutions of the score maps."""
    kam_options: KamOptions = field(default_factory=KamOptions)
    """Which boxes are scored, and what is right."""
    centred_anchors: bool = False
    """Whether anchors stand at the centres of the map's cells."""
    loss: LossWeights = field(default_factory=lambda: LossWeights(cls=2.0, loc=1.0, direction=0.2))
    """Weights of the head's losses (section 4.2: class 2, box 1, direction 0.2)."""
    keypoint_weight: float = 1.0
    """Weight of the keypoints' loss (section 4.2)."""
    swapped: bool = False
    """Exchange the weights of class and box: 1 and 2, as SECOND and SA-SSD have them."""
    smooth_l1_beta: float = 1 / 9
    """Where the regression loss turns linear."""
    post: PostProcess = field(default_factory=lambda: PostProcess(0.3, 0.1, 4096, 100))
    """Post-processing at test time."""

    def __post_init__(self) -> None:
        if not self.anchors:
            raise BeamboxError("`anchors` must name at least one class, got none")
        if not self.llm and self.neck not in (Neck.LLM, Neck.SECOND):
            raise BeamboxError(f"`llm` off is SECOND's backbone, but `neck` asks for {self.neck.value}; change one")
        if len(self.kam_options.positive_iou) not in (1, len(self.anchors)):
            raise BeamboxError(
                f"`kam_options.positive_iou` must have 1 entry or one for each of the {len(self.anchors)} classes, "
                f"got {len(self.kam_options.positive_iou)}"
            )

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes."""
        return tuple(anchor.name for anchor in self.anchors)

    @property
    def loss_weights(self) -> LossWeights:
        """Weights of the head's losses as they are used."""
        if not self.swapped:
            return self.loss
        return LossWeights(self.loss.loc, self.loss.cls, self.loss.direction)


@dataclass(frozen=True)
class KassdPredictions:
    """What the network says of a batch."""

    head: AnchorPredictions
    """Of every anchor."""
    maps: Tensor | None
    """``(B, classes * keypoints, Y, X)`` score maps, logits; None without KAM."""


class Kassd(nn.Module):
    """The network; see :class:`KassdConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`KassdPredictions` over the map of stride 8.
    """

    def __init__(self, config: KassdConfig) -> None:
        super().__init__()
        self.config = config
        self.anchors = AnchorGrid(config.anchors, config.grid, STRIDE, config.centred_anchors)
        self.encoder = VoxelEncoder(config.columns, config.encoder_widths, config.encoder_out)
        self.neck = make_neck(config, self.encoder.bev_channels(config.grid.shape[0]))
        self.head = AnchorHead(self.neck.out_channels, self.anchors)
        self.kam = (
            KeypointScores(self.neck.out_channels, config.keypoints, STRIDE, len(config.anchors), config.kam_width)
            if config.kam
            else None
        )

    def forward(self, batch: Batch, grid: VoxelGrid | None = None) -> KassdPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size."""
        grid = self.config.grid if grid is None else grid
        voxels = mean_voxels(self.voxels(batch, grid), self.config.absolute_xy)  # (V, columns)
        stages = self.encoder(voxels)
        bev = self.neck(stages.bev)  # (B, 128, ny / 8, nx / 8)
        maps = None if self.kam is None else self.kam(bev)  # (B, K, ny / 8, nx / 8)
        return KassdPredictions(self.head(bev, grid), maps)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps."""
        return (self.neck,)

    def voxels(self, batch: Batch, grid: VoxelGrid) -> Voxels:
        """Gather points into voxels."""
        config = self.config
        points = batch.points[:, : config.columns]
        return voxelize(points, batch.sample, batch.size, grid, config.max_points, config.max_voxels)

    def loss(self, predictions: KassdPredictions, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return the weighted losses ``cls``, ``loc``, ``direction`` and, with KAM, ``keypoints`` (equation 10).

        Objects of other classes are background.
        """
        config = self.config
        boxes, classes = targets_from(labels, config.classes, predictions.head.cls.device)
        losses = anchor_loss(predictions.head, boxes, classes, self.anchors, config.loss_weights, config.smooth_l1_beta)
        if predictions.maps is not None:
            terms = [self.keypoint_loss(predictions, i, *of_sample) for i, of_sample in enumerate(zip(boxes, classes))]
            losses["keypoints"] = config.keypoint_weight * torch.stack(terms).mean()
        return losses

    def keypoint_loss(self, predictions: KassdPredictions, sample: int, objects: Tensor, kinds: Tensor) -> Tensor:
        """Compute one sample's focal loss of the keypoints' scores, divided by the number of right boxes.

        Args:
            predictions: of the batch.
            sample: position in the batch.
            objects: ``(M, 7)`` labelled boxes.
            kinds: ``(M,)`` int64 classes.
        """
        options, head = self.config.kam_options, predictions.head
        rows, _, predicted = best_anchors(head, sample, options.threshold, options.train_boxes)
        if not len(rows):
            rows, _, predicted = best_anchors(head, sample, 0.0, options.train_least)
        inside = head.grid.contains(objects)
        boxes = torch.cat((head.decoded_rows(sample, rows), objects[inside]))
        classes = torch.cat((predicted, kinds[inside]))
        places = torch.cat((head.anchors[rows, :2], objects[inside, :2]))  # a labelled box is its own anchor
        logits = self.scores(predictions, sample, boxes if options.box_gradient else boxes.detach(), classes, places)
        target = self.quality(boxes.detach(), classes, objects, kinds)
        least = target.new_tensor(options.positive_iou).expand(len(self.config.anchors))[classes]
        right = (target >= least).float()
        wanted = (2 * target - 0.5).clamp(0, 1) if options.soft_targets else right
        return sigmoid_focal(logits.float(), wanted).sum() / right.sum().clamp(min=1)

    @staticmethod
    def quality(boxes: Tensor, classes: Tensor, objects: Tensor, kinds: Tensor) -> Tensor:
        """Return each box's largest 3-D overlap with an object of its class, ``(N,)``; 0 where there is none."""
        if not len(objects):
            return boxes.new_zeros(len(boxes))
        overlap = iou_3d(boxes, objects)  # (N, M)
        return torch.where(classes[:, None] == kinds, overlap, 0.0).amax(dim=1)

    def scores(
        self, predictions: KassdPredictions, sample: int, boxes: Tensor, classes: Tensor, places: Tensor
    ) -> Tensor:
        """Return the logits of boxes of one sample at their keypoints, ``(N,)``."""
        assert self.kam is not None and predictions.maps is not None
        return self.kam.score(predictions.maps, predictions.head.grid, sample, boxes, classes, places)

    def decode(self, predictions: KassdPredictions) -> list[Detections]:
        """Return the detections of each sample, best first."""
        if predictions.maps is None:
            kept = select_boxes(predictions.head, self.config.post)
        else:
            kept = [self.rescored(predictions, sample) for sample in range(len(predictions.maps))]
        return detections_from(kept, self.config.classes)

    def rescored(self, predictions: KassdPredictions, sample: int) -> tuple[Tensor, Tensor, Tensor]:
        """Keep the boxes of one sample that the keypoints call good: boxes, scores and classes, best first."""
        options, post, head = self.config.kam_options, self.config.post, predictions.head
        rows, by_class, label = best_anchors(head, sample, options.threshold, options.test_boxes)
        boxes = head.decoded_rows(sample, rows)
        score = torch.sigmoid(self.scores(predictions, sample, boxes, label, head.anchors[rows, :2]).float())
        if options.score is KamScore.MULTIPLY:
            score = score * by_class
        good = score >= post.score_threshold
        boxes, score, label = boxes[good], score[good], label[good]
        keep = nms(boxes, score, post.nms_iou, post.nms_pre, post.nms_post)
        return boxes[keep], score[keep], label[keep]


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


def make_neck(config: KassdConfig, in_channels: int) -> LocationAttention | BevBackbone | PyramidAttention:
    """Build what stands between encoder and head."""
    c = config.width
    if config.neck is Neck.SECOND or not config.llm:
        return BevBackbone(in_channels, (5, 5), (1, 2), (c, 2 * c), (1, 2), (2 * c, 2 * c))
    if config.neck is Neck.PSA:
        return PyramidAttention(in_channels, c)
    contexts = {Neck.LLM: None, Neck.DENSEASPP: DenseAspp, Neck.SPP: SpatialPyramidPooling}
    context = contexts[config.neck]
    return LocationAttention(
        in_channels, c, config.frs_reuse, config.lam, config.lam_reduce, None if context is None else context(2 * c)
    )


def kassd(config: KassdConfig | None = None) -> Kassd:
    """Build KASSD; without a configuration, the published KITTI one for cars (3.6 M parameters)."""
    return Kassd(config or KassdConfig())
