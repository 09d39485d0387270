"""Regions of interest: proposals, what they are taught, their refinement (Voxel R-CNN, section 3.3; PV-RCNN, 3.4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from beambox.geometry.boxes import corners_3d, local_to_world, rotate_z, wrap_angle
from beambox.layers.coders import decode_boxes, encode_boxes
from beambox.layers.heads import AnchorPredictions, PostProcess, best_of_samples, of_rows, suppressed
from beambox.layers.losses import smooth_l1
from beambox.ops.dispatch import waiting_is_dear
from beambox.ops.nms import nms, nms_of_samples
from beambox.ops.rotated_iou import iou_3d

__all__ = [
    "NmsConfig",
    "RoiSampling",
    "RoiTargets",
    "Rois",
    "best_overlap",
    "canonical_targets",
    "corner_loss",
    "decode_rois",
    "overlap_score",
    "propose",
    "roi_loss",
    "sample_rois",
    "select_rois",
]


@dataclass(frozen=True)
class NmsConfig:
    """How many of the first stage's boxes go on to the second."""

    pre: int
    """Best boxes that enter the suppression."""
    post: int
    """Boxes kept at most."""
    iou: float
    """Overlap (bird's-eye view) above which the lower-scored of two boxes is dropped."""


@dataclass(frozen=True)
class Rois:
    """Regions of interest of a batch, sample after sample; R in all.

    On a GPU, where their number would have to be waited for, each sample has as many, and ``valid`` says which exist.
    """

    boxes: Tensor
    """``(R, 7)``."""
    labels: Tensor
    """``(R,)`` int64 position of the class."""
    sample: Tensor
    """``(R,)`` int64, ascending."""
    batch_size: int
    """Number of samples; some may have no region."""
    valid: Tensor | None = None
    """``(R,)`` bool; the regions of a sample that exist come first. None where all do."""

    def of_sample(self, sample: int) -> Tensor:
        """Return the rows of a sample's regions, ``(M,)`` int64."""
        mine = self.sample == sample
        return torch.nonzero(mine if self.valid is None else mine & self.valid)[:, 0]


@dataclass(frozen=True)
class RoiSampling:
    """Which proposals the second stage is taught on, and what (PV-RCNN, section 3.4)."""

    rois_per_frame: int = 128
    """Regions drawn from each sample."""
    fg_fraction: float = 0.5
    """Share of positive ones at most."""
    fg_iou: float = 0.55
    """Overlap (3-D, with an object of the predicted class) from which a region is positive and regresses."""
    bg_iou_low: float = 0.1
    """Overlap below which a negative region is easy."""
    hard_bg_fraction: float = 0.8
    """Share of hard ones among the negatives."""
    cls_bg_iou: float = 0.25
    """Overlap at which the taught score is 0."""
    cls_fg_iou: float = 0.75
    """Overlap at which the taught score is 1."""


@dataclass(frozen=True)
class RoiTargets:
    """Sampled regions and what they are taught."""

    rois: Rois
    """R sampled regions."""
    boxes: Tensor
    """``(R, 7)`` the object each overlaps most; any where it overlaps none."""
    iou: Tensor
    """``(R,)`` that overlap."""
    score: Tensor
    """``(R,)`` the score to learn, in [0, 1]."""
    regress: Tensor
    """``(R,)`` bool: whether the box is to be learnt."""


def propose(predictions: AnchorPredictions, limits: NmsConfig) -> Rois:
    """Take each sample's best decoded boxes through a class-agnostic suppression; no gradient."""
    with torch.no_grad():
        if waiting_is_dear(predictions.cls):
            return _propose_of_samples(predictions, limits)
        decoded = predictions.decoded()
        score, label = predictions.cls.float().max(dim=-1)  # (B, N); the sigmoid would not change the order
        kept = [nms(boxes, s, limits.iou, limits.pre, limits.post) for boxes, s in zip(decoded, score)]
        counts = torch.tensor([len(rows) for rows in kept], device=score.device)
        return Rois(
            torch.cat([boxes[rows] for boxes, rows in zip(decoded, kept)]),
            torch.cat([of_sample[rows] for of_sample, rows in zip(label, kept)]),
            torch.repeat_interleave(torch.arange(len(kept), device=score.device), counts),
            len(kept),
        )


def _propose_of_samples(predictions: AnchorPredictions, limits: NmsConfig) -> Rois:
    """Propose as many regions for each sample, without asking how many exist."""
    score, label = predictions.cls.float().max(dim=-1)  # (B, N)
    score, rows, count = best_of_samples(score, -math.inf, limits.pre)
    boxes = predictions.decoded_places(rows)  # (B, P, 7)
    kept, number = nms_of_samples(boxes, count, limits.iou, limits.post)
    places = kept.clamp(min=0)  # (B, post)
    samples, post = places.shape
    place = torch.arange(samples * post, device=score.device)
    return Rois(
        of_rows(boxes, places).flatten(0, 1),
        label.gather(1, rows.gather(1, places)).flatten(),
        place // max(1, post),
        samples,
        (torch.arange(post, device=score.device) < number[:, None]).flatten(),
    )


def sample_rois(
    rois: Rois,
    boxes: Sequence[Tensor],
    classes: Sequence[Tensor],
    options: RoiSampling,
    generator: torch.Generator | None = None,
) -> RoiTargets:
    """Draw the regions to learn from; no gradient.

    Args:
        rois: proposals.
        boxes: for each sample ``(M, 7)`` objects.
        classes: for each sample ``(M,)`` int64 position of each object's class.
        options: numbers and thresholds.
        generator: source of randomness (on the CPU); PyTorch's default one, which trainers seed, where None.
    """
    chosen, matched, overlaps = [], [], []
    with torch.no_grad():
        for sample in range(rois.batch_size):
            rows = rois.of_sample(sample)
            if len(rows) == 0:
                continue
            iou, best = best_overlap(rois.boxes[rows], rois.labels[rows], boxes[sample], classes[sample])
            drawn = _draw(iou.cpu(), options, generator).to(rows.device)
            gt_boxes = boxes[sample].to(rois.boxes)
            chosen.append(rows[drawn])
            overlaps.append(iou[drawn])
            matched.append(gt_boxes[best[drawn]] if len(gt_boxes) else rois.boxes[rows[drawn]])
        if not chosen:
            nothing = rois.boxes.new_zeros(0)
            return RoiTargets(rois, rois.boxes, nothing, nothing, nothing.bool())
        row, iou = torch.cat(chosen), torch.cat(overlaps)
        picked = Rois(rois.boxes[row], rois.labels[row], rois.sample[row], rois.batch_size)
        return RoiTargets(picked, torch.cat(matched), iou, overlap_score(iou, options), iou > options.fg_iou)


def best_overlap(rois: Tensor, labels: Tensor, boxes: Tensor, classes: Tensor) -> tuple[Tensor, Tensor]:
    """Return each region's largest overlap with an object of its class, and that object.

    Args:
        rois: ``(R, 7)``.
        labels: ``(R,)`` int64 classes of the regions.
        boxes: ``(M, 7)`` objects.
        classes: ``(M,)`` int64 classes of the objects.

    Returns:
        ``(R,)`` 3-D overlaps, 0 where there is none, and ``(R,)`` int64 objects, any where there is none.
    """
    if len(boxes) == 0:
        return rois.new_zeros(len(rois)), labels.new_zeros(len(rois))
    iou = iou_3d(rois, boxes.to(rois))  # (R, M)
    iou = torch.where(labels[:, None] == classes.to(labels.device)[None], iou, 0.0)
    value, best = iou.max(dim=1)
    return value, best


def _draw(iou: Tensor, options: RoiSampling, generator: torch.Generator | None) -> Tensor:
    """Draw rows: positives without repetition, negatives with, hard ones first."""
    total = options.rois_per_frame
    positive = torch.nonzero(iou >= options.fg_iou)[:, 0]
    hard = torch.nonzero((iou < options.fg_iou) & (iou >= options.bg_iou_low))[:, 0]
    easy = torch.nonzero(iou < options.bg_iou_low)[:, 0]

    def repeated(rows: Tensor, count: int) -> Tensor:
        return rows[torch.randint(len(rows), (count,), generator=generator)]

    if len(hard) + len(easy) == 0:
        return repeated(positive, total)
    wanted = min(round(total * options.fg_fraction), len(positive))
    first = positive[torch.randperm(len(positive), generator=generator)[:wanted]]
    negatives = total - wanted
    if len(hard) == 0:
        return torch.cat((first, repeated(easy, negatives)))
    if len(easy) == 0:
        return torch.cat((first, repeated(hard, negatives)))
    of_hard = min(int(options.hard_bg_fraction * negatives), len(hard))
    return torch.cat((first, repeated(hard, of_hard), repeated(easy, negatives - of_hard)))


def overlap_score(iou: Tensor, options: RoiSampling) -> Tensor:
    """Return the score to learn: 0 up to ``cls_bg_iou``, 1 from ``cls_fg_iou`` on, linear between."""
    return ((iou - options.cls_bg_iou) / (options.cls_fg_iou - options.cls_bg_iou)).clamp(0, 1)


def canonical_targets(boxes: Tensor, rois: Tensor) -> Tensor:
    """Express objects in the frames of their regions, as box deltas to regress.

    The heading is taken relative to the region's and folded into [-pi / 2, pi / 2]: the second stage refines a
    heading and does not tell front from rear.

    Args:
        boxes: ``(R, 7)``.
        rois: ``(R, 7)``.

    Returns:
        ``(R, 7)`` codes relative to a box at the origin with the region's sizes.
    """
    center = rotate_z(boxes[:, :3] - rois[:, :3], -rois[:, 6])
    turn = wrap_angle(boxes[:, 6] - rois[:, 6], 0.0)  # [0, 2 pi)
    opposite = (turn > math.pi / 2) & (turn < 1.5 * math.pi)
    turn = wrap_angle(torch.where(opposite, turn + math.pi, turn)).clamp(-math.pi / 2, math.pi / 2)
    local = torch.cat((center, boxes[:, 3:6], turn[:, None]), dim=1)
    return encode_boxes(local, _at_origin(rois))


def decode_rois(deltas: Tensor, rois: Tensor) -> Tensor:
    """Inverse of :func:`canonical_targets`: ``(R, 7)`` boxes in the world, headings in [-pi, pi)."""
    local = decode_boxes(deltas, _at_origin(rois))
    center = local_to_world(local[:, None, :3], rois)[:, 0]
    return torch.cat((center, local[:, 3:6], wrap_angle(local[:, 6:] + rois[:, 6:7])), dim=1)


def _at_origin(rois: Tensor) -> Tensor:
    zeros = torch.zeros_like(rois[:, :1])
    return torch.cat((zeros, zeros, zeros, rois[:, 3:6], zeros), dim=1)


def corner_loss(predicted: Tensor, boxes: Tensor) -> Tensor:
    """Return the mean distance loss of eight corners, the object taken either way round: ``(R, 7)`` -> ``(R,)``."""
    turned = torch.cat((boxes[:, :6], boxes[:, 6:] + math.pi), dim=1)
    corners = corners_3d(predicted)
    distance = torch.minimum(
        torch.linalg.vector_norm(corners - corners_3d(boxes), dim=2),
        torch.linalg.vector_norm(corners - corners_3d(turned), dim=2),
    )  # (R, 8)
    return smooth_l1(distance, 1.0).mean(dim=1)


def roi_loss(cls: Tensor, deltas: Tensor, targets: RoiTargets) -> dict[str, Tensor]:
    """Compute the second stage's losses, all of weight 1.

    Args:
        cls: ``(R,)`` logits.
        deltas: ``(R, 7)`` box deltas.
        targets: of the same regions.

    Returns:
        Scalars ``roi_cls`` (mean over regions), ``roi_box`` and ``roi_corner`` (mean over regions that regress).
    """
    cls, deltas = cls.float(), deltas.float()
    classified = functional.binary_cross_entropy_with_logits(cls, targets.score, reduction="sum") / max(1, len(cls))
    regress = targets.regress
    reach = 0.0 * deltas.sum()  # keeps every parameter in the graph where nothing regresses
    if not bool(regress.any()):
        return {"roi_cls": classified, "roi_box": reach, "roi_corner": reach}
    rois, boxes, deltas = targets.rois.boxes[regress], targets.boxes[regress], deltas[regress]
    box = smooth_l1(deltas - canonical_targets(boxes, rois)).sum() / len(rois)
    corner = corner_loss(decode_rois(deltas, rois), boxes).mean()
    return {"roi_cls": classified, "roi_box": box, "roi_corner": corner}


def select_rois(rois: Rois, cls: Tensor, boxes: Tensor, options: PostProcess) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Keep the good refined boxes of each sample: threshold, class-agnostic rotated suppression.

    Args:
        rois: regions.
        cls: ``(R,)`` logits.
        boxes: ``(R, 7)`` refined boxes.
        options: thresholds.

    Returns:
        For each sample boxes ``(M, 7)``, scores ``(M,)`` and class positions ``(M,)``, best first.
    """
    kept = []
    score = torch.sigmoid(cls.float())
    if rois.valid is not None and len(boxes):
        score = torch.where(rois.valid, score, torch.nan).view(rois.batch_size, -1)  # (B, R / B)
        score, rows, count = best_of_samples(score, options.score_threshold, options.nms_pre)
        of_sample = boxes.view(rois.batch_size, -1, 7)
        label = rois.labels.view(rois.batch_size, -1).gather(1, rows)
        return suppressed(of_rows(of_sample, rows), score, label, count, options)
    for sample in range(rois.batch_size):
        row = rois.of_sample(sample)
        row = row[score[row] >= options.score_threshold]
        row = row[nms(boxes[row], score[row], options.nms_iou, options.nms_pre, options.nms_post)]
        kept.append((boxes[row], score[row], rois.labels[row]))
    return kept
