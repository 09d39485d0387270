"""The anchor head: class, box and direction of every anchor, its loss and its decoding (SECOND, section 3.2, 3.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import AnchorGrid
from beambox.layers.assigners import assign
from beambox.layers.coders import decode_boxes, direction_bin, encode_boxes, resolve_heading
from beambox.layers.losses import sigmoid_focal, sine_difference, smooth_l1
from beambox.ops.nms import nms

__all__ = ["AnchorHead", "AnchorPredictions", "LossWeights", "PostProcess", "anchor_loss", "select_boxes"]


@dataclass(frozen=True)
class AnchorPredictions:
    """What the head says of every anchor; N anchors in the order (y, x, class, rotation)."""

    cls: Tensor
    """``(B, N, K)`` class logits."""
    box: Tensor
    """``(B, N, 7)`` box codes relative to the anchors."""
    direction: Tensor
    """``(B, N, 2)`` logits of the two half turns."""
    anchors: Tensor
    """``(N, 7)``."""
    grid: VoxelGrid
    """The region the network looked at."""

    def decoded(self) -> Tensor:
        """Boxes with resolved headings, ``(B, N, 7)`` float32."""
        boxes = decode_boxes(self.box.float(), self.anchors)
        yaw = resolve_heading(boxes[..., 6], self.direction.argmax(dim=-1))
        return torch.cat((boxes[..., :6], yaw[..., None]), dim=-1)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the anchor head's three losses."""

    cls: float = 1.0
    """Classification."""
    loc: float = 2.0
    """Box regression."""
    direction: float = 0.2
    """Direction classification."""


@dataclass(frozen=True)
class PostProcess:
    """From anchors to detections at test time."""

    score_threshold: float = 0.1
    """Smallest score that is kept."""
    nms_iou: float = 0.01
    """Overlap (bird's-eye view) above which the lower-scored of two boxes is dropped."""
    nms_pre: int = 4096
    """Number of best boxes that enter the suppression."""
    nms_post: int = 500
    """Number of boxes kept at most."""


class AnchorHead(nn.Module):
    """Three 1 x 1 convolutions on a bird's-eye-view map."""

    def __init__(self, in_channels: int, anchors: AnchorGrid) -> None:
        super().__init__()
        self.anchors = anchors
        self.num_classes = len(anchors.classes)
        per_cell = anchors.per_cell
        self.cls = nn.Conv2d(in_channels, per_cell * self.num_classes, 1)
        self.box = nn.Conv2d(in_channels, per_cell * 7, 1)
        self.direction = nn.Conv2d(in_channels, per_cell * 2, 1)
        prior = 0.01  # share of positives that a fresh network predicts, so that the focal loss starts calm
        nn.init.constant_(self.cls.bias, -math.log((1 - prior) / prior))  # pyright: ignore[reportArgumentType]
        nn.init.normal_(self.box.weight, std=0.001)

    def forward(self, bev: Tensor, grid: VoxelGrid) -> AnchorPredictions:
        """Predict over a map.

        Args:
            bev: ``(B, in_channels, Y, X)``.
            grid: the region the map covers.
        """
        anchors = self.anchors.boxes(grid, bev.device)
        return AnchorPredictions(
            _per_anchor(self.cls(bev), self.num_classes),
            _per_anchor(self.box(bev), 7),
            _per_anchor(self.direction(bev), 2),
            anchors,
            grid,
        )


def _per_anchor(maps: Tensor, values: int) -> Tensor:
    """``(B, A * values, Y, X)`` -> ``(B, Y * X * A, values)``."""
    return maps.permute(0, 2, 3, 1).reshape(maps.shape[0], -1, values)


def anchor_loss(
    predictions: AnchorPredictions,
    boxes: Sequence[Tensor],
    classes: Sequence[Tensor],
    anchors: AnchorGrid,
    weights: LossWeights,
    beta: float = 1 / 9,
) -> dict[str, Tensor]:
    """Compute the head's losses, each already weighted; their sum is the total.

    Each sample's losses are sums over anchors divided by its number of positives (at least 1); the batch is averaged.

    Args:
        predictions: of the head.
        boxes: for each sample ``(M, 7)`` objects on the predictions' device.
        classes: for each sample ``(M,)`` int64 position of each object's class.
        anchors: what the anchors are made of.
        weights: of the three losses.
        beta: where smooth-L1 turns from quadratic to linear.

    Returns:
        Scalars ``cls``, ``loc``, ``direction``.
    """
    cls_sum = predictions.cls.new_zeros((), dtype=torch.float32)
    loc_sum, dir_sum = cls_sum, cls_sum
    for sample, (gt, kinds) in enumerate(zip(boxes, classes)):
        target = assign(anchors, predictions.grid, predictions.anchors, gt, kinds)
        positive = torch.nonzero(target.positive)[:, 0]
        count = max(1, len(positive))
        wanted = torch.zeros_like(predictions.cls[sample], dtype=torch.float32)  # (N, K)
        wanted[positive, target.label[positive] - 1] = 1.0
        focal = sigmoid_focal(predictions.cls[sample].float(), wanted)
        cls_sum = cls_sum + (focal * (target.label >= 0)[:, None]).sum() / count
        if len(positive) == 0:
            continue
        objects = gt[target.matched[positive]]  # (P, 7)
        codes = encode_boxes(objects, predictions.anchors[positive])
        difference = sine_difference(predictions.box[sample, positive].float(), codes)
        loc_sum = loc_sum + smooth_l1(difference, beta).sum() / count
        logits = predictions.direction[sample, positive].float()
        dir_sum = dir_sum + functional.cross_entropy(logits, direction_bin(objects[:, 6]), reduction="sum") / count
    size = max(1, len(boxes))
    # A batch without objects still reaches every parameter, so that distributed training does not wait for gradients.
    reach = 0.0 * (predictions.box.float().sum() + predictions.direction.float().sum())
    return {
        "cls": weights.cls * cls_sum / size,
        "loc": weights.loc * (loc_sum + reach) / size,
        "direction": weights.direction * dir_sum / size,
    }


def select_boxes(predictions: AnchorPredictions, options: PostProcess) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Keep the good boxes of each sample: threshold, the best ``nms_pre``, class-agnostic rotated suppression.

    Returns:
        For each sample boxes ``(M, 7)``, scores ``(M,)`` and class positions ``(M,)``, best first.
    """
    kept = []
    for sample in range(len(predictions.cls)):
        score, label = predictions.cls[sample].float().max(dim=-1)
        score = torch.sigmoid(score)
        candidate = torch.nonzero(score >= options.score_threshold)[:, 0]
        if len(candidate) > options.nms_pre:
            candidate = candidate[torch.topk(score[candidate], options.nms_pre).indices]
        boxes = decode_boxes(predictions.box[sample, candidate].float(), predictions.anchors[candidate])
        yaw = resolve_heading(boxes[:, 6], predictions.direction[sample, candidate].argmax(dim=-1))
        boxes = torch.cat((boxes[:, :6], yaw[:, None]), dim=1)
        keep = nms(boxes, score[candidate], options.nms_iou, options.nms_pre, options.nms_post)
        kept.append((boxes[keep], score[candidate][keep], label[candidate][keep]))
    return kept
