"""Non-maximum suppression by comparing each candidate with the boxes kept so far (numba)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit
from beambox.ops.rotated_iou.cpu import shared_area
from beambox.ops.rotated_iou.prepared import prepare

__all__ = ["nms"]


def nms(boxes: Tensor, scores: Tensor, threshold: float, pre: int = 4096, post: int = 500) -> Tensor:
    """Keep the best boxes that do not overlap a better one; see :func:`beambox.ops.nms.nms`."""
    order = scores.argsort(descending=True, stable=True)[:pre]
    kept = _greedy(prepare(boxes[order]).numpy(), float(threshold), min(post, len(order)))
    return order[torch.from_numpy(kept)]


@jit
def _greedy(boxes, threshold, post):
    """Return the rows kept of prepared boxes in falling order of score."""
    kept = np.empty(post, np.int64)
    best = np.empty((post, 4))  # x, y, radius, area of the kept boxes, close together in memory
    scratch = np.empty((4, 16))
    n = 0
    for i in range(len(boxes)):
        if n == post:
            break
        x, y, radius, area = boxes[i, 0], boxes[i, 1], boxes[i, 6], 4 * boxes[i, 2] * boxes[i, 3]
        free = True
        for k in range(n):
            dx, dy, reach = best[k, 0] - x, best[k, 1] - y, best[k, 2] + radius
            if not dx * dx + dy * dy <= reach * reach:
                continue
            shared = shared_area(boxes[kept[k]], boxes[i], scratch)
            union = best[k, 3] + area - shared
            if union > 0 and min(1.0, shared / union) > threshold:
                free = False
                break
        if free:
            kept[n] = i
            best[n, 0], best[n, 1], best[n, 2], best[n, 3] = x, y, radius, area
            n += 1
    return kept[:n]
