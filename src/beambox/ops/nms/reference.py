"""Non-maximum suppression in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.rotated_iou.reference import iou_bev

__all__ = ["nms", "nms_of_samples"]


def nms(boxes: Tensor, scores: Tensor, threshold: float, pre: int = 4096, post: int = 500) -> Tensor:
    """Keep the best boxes that do not overlap a better one; see :func:`beambox.ops.nms.nms`."""
    order = scores.argsort(descending=True, stable=True)[:pre]  # stable: of equals, the first
    best = boxes[order].double()
    overlaps = (iou_bev(best, best) > threshold).cpu()  # (P, P)
    suppressed = torch.zeros(len(order), dtype=torch.bool)
    kept: list[int] = []
    for candidate in range(len(order)):
        if suppressed[candidate]:
            continue
        kept.append(candidate)
        if len(kept) == post:
            break
        suppressed |= overlaps[candidate]
    return order[torch.tensor(kept, dtype=torch.int64, device=order.device)]


def nms_of_samples(boxes: Tensor, count: Tensor, threshold: float, post: int) -> tuple[Tensor, Tensor]:
    """Keep the best boxes of each sample; see :func:`beambox.ops.nms.nms_of_samples`."""
    kept = torch.full((len(boxes), post), -1, dtype=torch.int64, device=boxes.device)
    number = torch.zeros_like(count)
    for sample, known in enumerate(count.tolist()):
        falling = -torch.arange(known, device=boxes.device)
        rows = nms(boxes[sample, :known], falling, threshold, known, post) if known and post else falling[:0]
        kept[sample, : len(rows)], number[sample] = rows, len(rows)
    return kept, number
