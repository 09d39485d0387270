"""Non-maximum suppression on a GPU: Triton finds who overlaps whom, one bit a pair; the CPU walks the bits (numba)."""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false

from __future__ import annotations

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.ops.jit import jit
from beambox.ops.rotated_iou.gpu import shared_area
from beambox.ops.rotated_iou.prepared import prepare

__all__ = ["nms"]

ROWS = 32


def nms(boxes: Tensor, scores: Tensor, threshold: float, pre: int = 4096, post: int = 500) -> Tensor:
    """Keep the best boxes that do not overlap a better one; see :func:`beambox.ops.nms.nms`."""
    order = scores.argsort(descending=True, stable=True)[:pre]
    count = len(order)
    words = triton.cdiv(count, 64)
    overlaps = torch.empty(count, words, dtype=torch.int64, device=boxes.device)
    limit = torch.full((1,), threshold, dtype=torch.float64, device=boxes.device)  # as a number it would be float32
    _mark[(triton.cdiv(count, ROWS), words)](prepare(boxes[order]), overlaps, count, words, limit, ROWS)
    kept = _greedy(overlaps.cpu().numpy(), min(post, count))  # 2 MB for 4096 boxes
    return order[torch.from_numpy(kept).to(order.device)]


@triton.jit
def _mark(boxes, overlaps, count, words, limit, rows: tl.constexpr):
    """Set bit j of word w of row i where boxes i and 64 w + j overlap by more than the limit."""
    i = (tl.program_id(0) * rows + tl.arange(0, rows))[:, None]
    word = tl.program_id(1)
    bit = tl.arange(0, 64)[None, :]
    j = word * 64 + bit
    shared = shared_area(boxes, i, i < count, boxes, j, j < count)  # (rows, 64)
    area_i = 4 * tl.load(boxes + i * 9 + 2, i < count, 0.0) * tl.load(boxes + i * 9 + 3, i < count, 0.0)
    area_j = 4 * tl.load(boxes + j * 9 + 2, j < count, 0.0) * tl.load(boxes + j * 9 + 3, j < count, 0.0)
    union = area_i + area_j - shared
    iou = tl.minimum(shared / tl.where(union > 0, union, 1.0), 1.0)
    over = (union > 0) & (iou > tl.load(limit))
    packed = tl.sum(tl.where(over, 1, 0).to(tl.int64) << bit.to(tl.int64), axis=1)  # (rows,)
    row = tl.program_id(0) * rows + tl.arange(0, rows)
    tl.store(overlaps + row * words + word, packed, row < count)


@jit
def _greedy(overlaps, post):
    """Return the rows kept of (P, W) words of overlap bits, rows in falling order of score."""
    kept = np.empty(post, np.int64)
    gone = np.zeros(overlaps.shape[1], np.int64)
    n = 0
    for i in range(len(overlaps)):
        if n == post:
            break
        if (gone[i >> 6] >> (i & 63)) & 1 == 0:
            kept[n] = i
            n += 1
            for w in range(overlaps.shape[1]):
                gone[w] |= overlaps[i, w]
    return kept[:n]
