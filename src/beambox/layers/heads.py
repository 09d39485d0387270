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
from beambox.ops.dispatch import exporting, waiting_is_dear
from beambox.ops.map_conv import GroundedConv, MapKernel
from beambox.ops.nms import nms, nms_of_samples

__all__ = [
    "AnchorHead",
    "AnchorPredictions",
    "LossWeights",
    "PostProcess",
    "anchor_loss",
    "best_anchors",
    "best_of_samples",
    "of_rows",
    "select_boxes",
    "suppressed",
]


@dataclass(frozen=True)
class AnchorPredictions:
    """What the head says of every anchor; N anchors in the order (y, x, class, rotation)."""

    cls: Tensor
    """``(B, N, K)`` class logits."""
    box: Tensor
    """``(B, N, 7)`` box deltas relative to the anchors."""
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

    def decoded_rows(self, sample: int, rows: Tensor) -> Tensor:
        """Boxes of some anchors of one sample with resolved headings: ``(M,)`` int64 -> ``(M, 7)`` float32."""
        boxes = decode_boxes(self.box[sample, rows].float(), self.anchors[rows])
        yaw = resolve_heading(boxes[:, 6], self.direction[sample, rows].argmax(dim=-1))
        return torch.cat((boxes[:, :6], yaw[:, None]), dim=1)

    def decoded_places(self, rows: Tensor) -> Tensor:
        """Boxes of some anchors of each sample with resolved headings: ``(B, P)`` int64 -> ``(B, P, 7)`` float32."""
        boxes = decode_boxes(of_rows(self.box, rows).float(), self.anchors[rows])
        yaw = resolve_heading(boxes[..., 6], of_rows(self.direction, rows).argmax(dim=-1))
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
    """Three 1 x 1 convolutions on a bird's-eye-view map; once folded, one."""

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
        self.is_folded = False
        self._one: tuple[tuple[int, ...], GroundedConv] | None = None

    def fold(self) -> None:
        """Make one operation of the three convolutions wherever that is faster; training ends here."""
        self.is_folded = True

    def joined(self) -> tuple[Tensor, Tensor]:
        """Return weight ``(A * (K + 7 + 2), C)`` and bias of the three convolutions as one."""
        layers = (self.cls, self.box, self.direction)
        biases = [layer.bias for layer in layers if layer.bias is not None]
        return torch.cat([layer.weight.flatten(1) for layer in layers]), torch.cat(biases)

    @torch.inference_mode(False)
    @torch.no_grad()
    def one(self) -> GroundedConv | None:
        """Return the three as one convolution, made anew once a weight has changed; None where changes do not show."""
        weights = list(self.parameters())
        if any(weight.is_inference() for weight in weights):
            return None
        state = tuple(n for weight in weights for n in (weight.data_ptr(), weight._version))
        if self._one is None or self._one[0] != state:
            weight, bias = self.joined()
            self._one = (state, GroundedConv(MapKernel(weight[:, :, None, None], bias)))
        return self._one[1]

    def forward(self, bev: Tensor, grid: VoxelGrid) -> AnchorPredictions:
        """Predict over a map.

        Args:
            bev: ``(B, in_channels, Y, X)``.
            grid: the region the map covers.
        """
        layers = (self.cls, self.box, self.direction)
        one = self.one() if self.is_folded else None
        if one is not None and one.is_fused(bev):
            cells = one(bev).permute(0, 2, 3, 1)  # (B, Y, X, A * (K + 7 + 2))
        else:  # a 1 x 1 convolution is a matrix product, and one is faster than three
            cells = functional.linear(bev.permute(0, 2, 3, 1), *self.joined())  # (B, Y, X, A * (K + 7 + 2))
        cls, box, direction = cells.split([layer.out_channels for layer in layers], dim=-1)
        size = len(bev)
        return AnchorPredictions(
            cls.reshape(size, -1, self.num_classes),
            box.reshape(size, -1, 7),
            direction.reshape(size, -1, 2),
            self.anchors.boxes(grid, bev.device),
            grid,
        )


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
    targets = [
        assign(anchors, predictions.grid, predictions.anchors, gt, class_ids) for gt, class_ids in zip(boxes, classes)
    ]
    label = torch.stack([target.label for target in targets])  # (B, N)
    sample, anchor = torch.nonzero(label > 0, as_tuple=True)  # (P,) each
    count = (label > 0).sum(dim=1).clamp(min=1).float()  # (B,)
    share = 1 / (count * len(targets))  # (B,) weight of one anchor of each sample

    wanted = torch.zeros_like(predictions.cls, dtype=torch.float32)  # (B, N, K)
    wanted[sample, anchor, label[sample, anchor] - 1] = 1.0
    focal = sigmoid_focal(predictions.cls.float(), wanted).sum(dim=-1)  # (B, N)
    cls = ((focal * (label >= 0)).sum(dim=1) * share).sum()

    gt_boxes = torch.cat([gt[t.gt_index[t.positive]] for gt, t in zip(boxes, targets)])  # (P, 7)
    deltas = encode_boxes(gt_boxes, predictions.anchors[anchor])
    difference = sine_difference(predictions.box[sample, anchor].float(), deltas)
    loc = (smooth_l1(difference, beta).sum(dim=1) * share[sample]).sum()
    logits = predictions.direction[sample, anchor].float()
    turned = functional.cross_entropy(logits, direction_bin(gt_boxes[:, 6]), reduction="none")
    direction = (turned * share[sample]).sum()
    return {"cls": weights.cls * cls, "loc": weights.loc * loc, "direction": weights.direction * direction}


def best_anchors(
    predictions: AnchorPredictions, sample: int, threshold: float, limit: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the anchors of one sample whose best class scores at least ``threshold``; of more than ``limit`` the best.

    Returns:
        Rows ``(M,)`` int64, scores ``(M,)`` float32 and class positions ``(M,)`` int64, in no particular order.
    """
    score, label = predictions.cls[sample].float().max(dim=-1)
    score = torch.sigmoid(score)
    rows = torch.nonzero(score >= threshold)[:, 0]
    if len(rows) > limit:
        rows = rows[torch.topk(score[rows], limit).indices]
    return rows, score[rows], label[rows]


def select_boxes(predictions: AnchorPredictions, options: PostProcess) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Keep the good boxes of each sample: threshold, the best ``nms_pre``, class-agnostic rotated suppression.

    Returns:
        For each sample boxes ``(M, 7)``, scores ``(M,)`` and class positions ``(M,)``, best first; of predictions on a
        GPU they lie on the CPU, as reading them is all that was left to do.
    """
    if waiting_is_dear(predictions.cls):
        score, label = predictions.cls.float().max(dim=-1)  # (B, N)
        score, rows, count = best_of_samples(torch.sigmoid(score), options.score_threshold, options.nms_pre)
        return suppressed(predictions.decoded_places(rows), score, label.gather(1, rows), count, options)
    kept = []
    for sample in range(len(predictions.cls)):
        rows, score, label = best_anchors(predictions, sample, options.score_threshold, options.nms_pre)
        boxes = predictions.decoded_rows(sample, rows)
        keep = nms(boxes, score, options.nms_iou, options.nms_pre, options.nms_post)
        kept.append((boxes[keep], score[keep], label[keep]))
    return kept


def of_rows(values: Tensor, rows: Tensor) -> Tensor:
    """Take some rows of each sample: ``(B, N, C)`` and ``(B, P)`` int64 -> ``(B, P, C)``."""
    return values.gather(1, rows[..., None].expand(*rows.shape, values.shape[-1]))


def best_of_samples(score: Tensor, threshold: float, limit: int) -> tuple[Tensor, Tensor, Tensor]:
    """Sort each sample's scores, of equals the first first, without asking how many reach the threshold.

    Args:
        score: ``(B, N)``; what is NaN never counts.
        threshold: smallest score that counts.
        limit: the most that count, of a sample.

    Returns:
        The P best scores ``(B, P)`` and their rows ``(B, P)`` int64, and how many of them count ``(B,)`` int64.
    """
    known = torch.where(score >= threshold, score, -torch.inf)
    if exporting():  # the operator of ONNX; which of equals comes first is its own affair
        known, rows = known.topk(min(limit, known.shape[1]), dim=1)
        return known, rows, (known > -torch.inf).sum(dim=1)
    known, rows = known.sort(dim=1, descending=True, stable=True)
    known, rows = known[:, :limit], rows[:, :limit]
    return known, rows, (known > -torch.inf).sum(dim=1)


def suppressed(
    boxes: Tensor, score: Tensor, label: Tensor, count: Tensor, options: PostProcess
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Suppress the boxes of all samples on their device and bring what is left to the CPU, which waits once.

    Args:
        boxes: ``(B, P, 7)``, each sample's best first.
        score: ``(B, P)``.
        label: ``(B, P)`` int64.
        count: ``(B,)`` int64 how many of the P there are.
        options: overlap and number kept.

    Returns:
        As :func:`select_boxes`.
    """
    kept, number = nms_of_samples(boxes, count, options.nms_iou, options.nms_post)
    rows = kept.clamp(min=0)  # (B, post)
    columns = torch.cat(
        (of_rows(boxes, rows), score.gather(1, rows)[..., None], label.gather(1, rows)[..., None]), dim=2
    )
    packed = torch.cat((columns.flatten(), number.to(columns.dtype))).cpu()  # whole numbers this small are exact
    table = packed[: columns.numel()].view(columns.shape)
    numbers = [int(n) for n in packed[columns.numel() :].tolist()]
    return [(one[:n, :7], one[:n, 7], one[:n, 8].long()) for one, n in zip(table, numbers)]
