"""Non-maximum suppression in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.rotated_iou.reference import iou_bev

__all__ = ["nms"]


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
