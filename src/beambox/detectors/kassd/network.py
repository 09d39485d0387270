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
  has class 1, box 2: ``swap_cls_loc_weights``;
* smooth-L1 turns linear at 1/9, as in SECOND's code, not at 1 as printed (``smooth_l1_beta``);
* learning rate, augmentation and post-processing are missing: those of SA-SSD, its nearest relative.

Added: several classes, each with its own score maps; ``neck`` for the paper's table 5; ``centered_anchors``.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, choose_fields, chosen
from beambox.detectors.contract import detections_from, expect_made, targets_from
from beambox.detectors.kassd.keypoints import KeypointLayout, KeypointScores
from beambox.detectors.kassd.necks import DenseASPP, PyramidAttention, SpatialPyramidPooling
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
    best_of_samples,
    of_rows,
    select_boxes,
    suppressed,
)
from beambox.layers.losses import sigmoid_focal
from beambox.layers.roi import best_overlap
from beambox.ops.dispatch import exporting, waiting_is_dear
from beambox.ops.nms import nms
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = [
    "KASSD",
    "FeatureReuse",
    "KASSDConfig",
    "KASSDPredictions",
    "KamOptions",
    "KamScore",
    "LamReduce",
    "LocationAttention",
    "Neck",
    "kassd",
    "location_attention",
    "location_weights",
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
    """3-D overlap with an object of its class from which a box is right: one for all classes, or one per class."""
    soft_targets: bool = False
    """Learn ``2 IoU - 0.5``, cut to [0, 1], instead of right or wrong."""
    box_gradient: bool = False
    """Whether the scores' loss also moves the boxes."""
    score: KamScore = KamScore.REPLACE
    """What becomes of the score at test time: replace or multiply the class score."""

    def __post_init__(self) -> None:
        choose_fields(self)


@dataclass(frozen=True)
class KASSDConfig:
    """Everything that defines the network; the defaults are the published KITTI setting, cars only."""

    anchors: tuple[AnchorClass, ...] = KITTI_ANCHORS[:1]
    """One anchor shape per class; also the classes and their order (section 4.2)."""
    grid: VoxelGrid = KITTI_VOXELS
    """Region and voxel size in metres (section 4.2: 0.05 x 0.05 x 0.1)."""
    max_points: int = 5
    """Points kept in a voxel, in scan order."""
    max_voxels: int | None = 40000
    """Voxels kept in a sweep, in order of first appearance; None keeps all."""
    num_point_features: int = 4
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
    centered_anchors: bool = False
    """Whether anchors stand at the centres of the map's cells."""
    loss: LossWeights = field(default_factory=lambda: LossWeights(cls=2.0, loc=1.0, direction=0.2))
    """Weights of the head's losses (section 4.2: class 2, box 1, direction 0.2)."""
    keypoint_weight: float = 1.0
    """Weight of the keypoints' loss (section 4.2)."""
    swap_cls_loc_weights: bool = False
    """Exchange the weights of class and box: 1 and 2, as SECOND and SA-SSD have them."""
    smooth_l1_beta: float = 1 / 9
    """Where the regression loss turns linear."""
    post: PostProcess = field(default_factory=lambda: PostProcess(0.3, 0.1, 4096, 100))
    """Post-processing at test time."""

    def __post_init__(self) -> None:
        choose_fields(self)
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
        if not self.swap_cls_loc_weights:
            return self.loss
        return LossWeights(self.loss.loc, self.loss.cls, self.loss.direction)


@dataclass(frozen=True)
class Candidates:
    """Boxes that KAM looks at, sample after sample; N in all."""

    boxes: Tensor
    """``(N, 7)`` with resolved headings."""
    classes: Tensor
    """``(N,)`` int64."""
    cls: Tensor
    """``(N,)`` the head's score of that class, in [0, 1]; 1 for labelled boxes."""
    anchor_xy: Tensor
    """``(N, 2)`` x, y of the anchors they come from; a labelled box is its own anchor."""
    sample: Tensor
    """``(N,)`` int64, ascending."""
    quality: Tensor | None
    """``(N,)`` largest 3-D overlap with an object of the box's class; None without labels."""
    valid: Tensor | None = None
    """``(N,)`` bool, where each sample has as many boxes, so that no GPU is waited for; None where all exist."""


@dataclass(frozen=True)
class KASSDPredictions:
    """What the network says of a batch."""

    head: AnchorPredictions
    """Of every anchor."""
    maps: Tensor | None
    """``(B, classes * keypoints, Y, X)`` score maps, logits; None without KAM, like what follows."""
    candidates: Candidates | None
    """The boxes that KAM looked at."""
    scores: Tensor | None
    """``(N,)`` what their keypoints say of them, logits."""


class KASSD(nn.Module):
    """The network; see :class:`KASSDConfig`.

    ``model(batch)`` takes a :class:`Batch` of sweeps and returns :class:`KASSDPredictions` over the map of stride 8.
    """

    def __init__(self, config: KASSDConfig) -> None:
        super().__init__()
        self.config = config
        self.anchors = AnchorGrid(config.anchors, config.grid, STRIDE, config.centered_anchors)
        self.encoder = VoxelEncoder(config.num_point_features, config.encoder_widths, config.encoder_out)
        self.neck = make_neck(config, self.encoder.bev_channels(config.grid.shape[0]))
        self.head = AnchorHead(self.neck.out_channels, self.anchors)
        nn.init.normal_(self.head.cls.weight, std=0.01)  # behind LLM, default weights would spread the prior of 0.01
        self.kam = (
            KeypointScores(self.neck.out_channels, config.keypoints, STRIDE, len(config.anchors), config.kam_width)
            if config.kam
            else None
        )

    def forward(
        self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None
    ) -> KASSDPredictions:
        """Predict over the configured region, or over ``grid``, which must have cells of the same size.

        With ``labels`` KAM scores the boxes it learns from, without those that may become detections.
        """
        return self.from_voxels(self.voxels(batch, self.config.grid if grid is None else grid), labels)

    def from_voxels(self, voxels: Voxels, labels: Sequence[Labels] | None = None) -> KASSDPredictions:
        """Predict from points that are already gathered into voxels."""
        grid = voxels.grid
        means = mean_voxels(voxels, self.config.absolute_xy)  # (V, columns)
        stages = self.encoder(means)
        bev = self.neck(stages.bev)  # (B, 128, ny / 8, nx / 8)
        head = self.head(bev, grid)
        if self.kam is None:
            return KASSDPredictions(head, None, None, None)
        maps = self.kam(bev)  # (B, K, ny / 8, nx / 8)
        boxes = self.candidates(head, labels)  # N boxes
        scores = self.kam.score(maps, grid, boxes.sample, boxes.boxes, boxes.classes, boxes.anchor_xy)  # (N,)
        return KASSDPredictions(head, maps, boxes, scores)

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps."""
        return (self.neck,)

    def voxels(self, batch: Batch, grid: VoxelGrid) -> Voxels:
        """Gather points into voxels."""
        config = self.config
        points = batch.points[:, : config.num_point_features]
        return voxelize(points, batch.sample, batch.size, grid, config.max_points, config.max_voxels)

    def loss(self, predictions: KASSDPredictions, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return the weighted losses ``cls``, ``loc``, ``direction`` and, with KAM, ``keypoints`` (equation 10).

        Objects of other classes are background.
        """
        config = self.config
        boxes, classes = targets_from(labels, config.classes, predictions.head.cls.device)
        losses = anchor_loss(predictions.head, boxes, classes, self.anchors, config.loss_weights, config.smooth_l1_beta)
        if predictions.candidates is not None and predictions.scores is not None:
            losses["keypoints"] = config.keypoint_weight * self.keypoint_loss(
                predictions.candidates, predictions.scores, len(boxes)
            )
        return losses

    def keypoint_loss(self, candidates: Candidates, scores: Tensor, batch_size: int) -> Tensor:
        """Compute the focal loss of the keypoints' scores, of each sample over its right boxes; the mean of samples."""
        options, quality = self.config.kam_options, candidates.quality
        expect_made(quality is not None, wanted=True)
        assert quality is not None
        least = quality.new_tensor(options.positive_iou).expand(len(self.config.anchors))[candidates.classes]
        positive = (quality >= least).float()
        wanted = (2 * quality - 0.5).clamp(0, 1) if options.soft_targets else positive
        focal = sigmoid_focal(scores.float(), wanted)  # (N,)
        of_sample = focal.new_zeros(batch_size).index_add(0, candidates.sample, focal)  # (B,)
        count = positive.new_zeros(batch_size).index_add(0, candidates.sample, positive)  # (B,)
        return (of_sample / count.clamp(min=1)).mean()

    def candidates(self, head: AnchorPredictions, labels: Sequence[Labels] | None) -> Candidates:
        """Choose the boxes that KAM looks at, as :class:`KamOptions` says.

        Without labels: the head's best. With labels: more of them, the labelled boxes, and how good each is.
        """
        of_samples = range(len(head.cls))
        if labels is None and (exporting() or waiting_is_dear(head.cls)):
            return self.best_of_samples(head)
        if labels is None:
            chosen = [self.best_boxes(head, sample, self.config.kam_options.test_boxes) for sample in of_samples]
        else:
            gt_boxes, class_ids = targets_from(labels, self.config.classes, head.cls.device)
            chosen = [self.boxes_to_learn(head, sample, gt_boxes[sample], class_ids[sample]) for sample in of_samples]
        quality = None if labels is None else torch.cat([c.quality for c in chosen if c.quality is not None])
        return Candidates(
            torch.cat([c.boxes for c in chosen]),
            torch.cat([c.classes for c in chosen]),
            torch.cat([c.cls for c in chosen]),
            torch.cat([c.anchor_xy for c in chosen]),
            torch.cat([c.sample for c in chosen]),
            quality,
        )

    def best_of_samples(self, head: AnchorPredictions) -> Candidates:
        """Return as many of each sample's best boxes, without asking how many reach the threshold."""
        options = self.config.kam_options
        score, label = head.cls.float().max(dim=-1)  # (B, N)
        score, rows, count = best_of_samples(torch.sigmoid(score), options.threshold, options.test_boxes)
        place = torch.arange(rows.numel(), device=rows.device)
        return Candidates(
            head.decoded_places(rows).flatten(0, 1),
            label.gather(1, rows).flatten(),
            score.flatten(),
            head.anchors[rows, :2].flatten(0, 1),
            place // max(1, rows.shape[1]),
            None,
            place % max(1, rows.shape[1]) < count.repeat_interleave(rows.shape[1]),
        )

    def best_boxes(self, head: AnchorPredictions, sample: int, limit: int, least: int = 0) -> Candidates:
        """Return one sample's best boxes from the threshold on; where there is none, the best ``least``."""
        rows, cls, classes = best_anchors(head, sample, self.config.kam_options.threshold, limit)
        if not len(rows) and least:
            rows, cls, classes = best_anchors(head, sample, 0.0, least)
        boxes = head.decoded_rows(sample, rows)
        return Candidates(boxes, classes, cls, head.anchors[rows, :2], torch.full_like(rows, sample), None)

    def boxes_to_learn(self, head: AnchorPredictions, sample: int, gt_boxes: Tensor, class_ids: Tensor) -> Candidates:
        """Return one sample's best boxes and its labelled ones, and how good they are.

        Args:
            head: predictions.
            sample: position in the batch.
            gt_boxes: ``(M, 7)`` labelled boxes.
            class_ids: ``(M,)`` int64 classes.
        """
        options = self.config.kam_options
        found = self.best_boxes(head, sample, options.train_boxes, options.train_least)
        inside = head.grid.contains(gt_boxes)
        labeled, their_classes = gt_boxes[inside], class_ids[inside]
        boxes = torch.cat((found.boxes if options.box_gradient else found.boxes.detach(), labeled))
        classes = torch.cat((found.classes, their_classes))
        return Candidates(
            boxes,
            classes,
            torch.cat((found.cls, found.cls.new_ones(len(labeled)))),
            torch.cat((found.anchor_xy, labeled[:, :2])),
            torch.full_like(classes, sample),
            best_overlap(boxes.detach(), classes, gt_boxes, class_ids)[0],
        )

    def decode(self, predictions: KASSDPredictions) -> list[Detections]:
        """Return the detections of each sample, best first."""
        if predictions.candidates is None or predictions.scores is None:
            kept = select_boxes(predictions.head, self.config.post)
        else:
            kept = self.select(predictions.candidates, predictions.scores, len(predictions.head.cls))
        return detections_from(kept, self.config.classes)

    def select(self, found: Candidates, scores: Tensor, batch_size: int) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Keep the boxes that the keypoints call good: boxes, scores and classes of each sample, best first."""
        expect_made(found.quality is not None, wanted=False)
        post, kept = self.config.post, []
        score = torch.sigmoid(scores.float())
        if self.config.kam_options.score is KamScore.MULTIPLY:
            score = score * found.cls
        if found.valid is not None:
            score = torch.where(found.valid, score, torch.nan).view(batch_size, -1)  # (B, N / B)
            score, rows, count = best_of_samples(score, post.score_threshold, post.nms_pre)
            boxes = of_rows(found.boxes.view(batch_size, -1, 7), rows)
            return suppressed(boxes, score, found.classes.view(batch_size, -1).gather(1, rows), count, post)
        for sample in range(batch_size):
            row = torch.nonzero((found.sample == sample) & (score >= post.score_threshold))[:, 0]
            row = row[nms(found.boxes[row], score[row], post.nms_iou, post.nms_pre, post.nms_post)]
            kept.append((found.boxes[row], score[row], found.classes[row]))
        return kept


def location_attention(high: Tensor, low: Tensor, reduce: LamReduce | str = LamReduce.SUM) -> Tensor:
    """Join two maps by a softmax over the pair at every place (LAM; KASSD, equations 1 and 2).

    ``(p0, p1) = softmax(sum_c high, sum_c low)``, output ``p0 * high + p1 * low``. It has no parameters.

    Args:
        high: ``(B, C, Y, X)`` features of the higher level (F3).
        low: ``(B, C, Y, X)`` features of the lower level (F4).
        reduce: from a place's channels to one number.

    Returns:
        ``(B, C, Y, X)``.
    """
    reduce = chosen("reduce", reduce, LamReduce)
    return low + location_weights(high, low, reduce) * (high - low)


def location_weights(high: Tensor, low: Tensor, reduce: LamReduce = LamReduce.SUM) -> Tensor:
    """Return the weight of the higher level at every place, ``(B, 1, Y, X)``; see :func:`location_attention`."""
    difference = (high - low).sum(dim=1, keepdim=True, dtype=torch.promote_types(high.dtype, torch.float32))
    if reduce is LamReduce.MEAN:
        difference = difference / high.shape[1]
    return torch.sigmoid(difference).to(high.dtype)  # the softmax of a pair


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
        reduce: LamReduce | str = LamReduce.SUM,
        context: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.levels = FeatureReuse(in_channels, width, reuse, context)
        self.lam, self.reduce = lam, chosen("reduce", reduce, LamReduce)
        self.out_channels = width
        if lam and self.reduce is LamReduce.SUM:
            self.open_lam(width)

    def open_lam(self, width: int) -> None:
        """Start with levels whose channel sums differ by about 1, so that both learn.

        The paper names no initialisation. By PyTorch's, the sums over 128 channels differ by 88 at the start, the
        softmax is 1 and 0 to the last bit, and F4 gets no gradient until it happens to win somewhere. Both
        deconvolutions start alike, so that they cancel, and F0 and F1, which are left, start small: 2 / c.
        """
        levels = self.levels
        levels.up_low.load_state_dict(levels.up_high.state_dict())
        for block in (levels.reduce, levels.three[-1]):
            nn.init.constant_(block[1].weight, 2 / width)  # pyright: ignore

    def forward(self, bev: Tensor) -> Tensor:
        """Map ``(B, in_channels, Y, X)`` to ``(B, width, Y, X)``."""
        high, low = self.levels(bev)
        return location_attention(high, low, self.reduce) if self.lam else high + low


def make_neck(config: KASSDConfig, in_channels: int) -> LocationAttention | BevBackbone | PyramidAttention:
    """Build what stands between encoder and head."""
    c = config.width
    if config.neck is Neck.SECOND or not config.llm:
        return BevBackbone(in_channels, (5, 5), (1, 2), (c, 2 * c), (1, 2), (2 * c, 2 * c))
    if config.neck is Neck.PSA:
        return PyramidAttention(in_channels, c)
    contexts = {Neck.LLM: None, Neck.DENSEASPP: DenseASPP, Neck.SPP: SpatialPyramidPooling}
    context = contexts[config.neck]
    return LocationAttention(
        in_channels, c, config.frs_reuse, config.lam, config.lam_reduce, None if context is None else context(2 * c)
    )


def kassd(config: KASSDConfig | None = None) -> KASSD:
    """Build KASSD; without a configuration, the published KITTI one for cars (3.6 M parameters)."""
    return KASSD(config or KASSDConfig())
