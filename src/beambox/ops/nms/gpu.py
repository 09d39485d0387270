"""Non-maximum suppression on a GPU (Triton): who overlaps whom, one bit a pair, then the walk over the bits.

The walk takes 64 candidates at a time. Within these, who stays is the one answer to "a candidate stays if none that
stays before it overlaps it", found by asking again until nothing changes; the words of those that stay are then joined
into what is gone. One program per sample, and the host waits for nothing.
"""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.geometry.constants import constant
from beambox.ops.rotated_iou.gpu import shared_area
from beambox.ops.rotated_iou.prepared import prepare

__all__ = ["nms", "nms_of_samples"]

ROWS = 32


def nms(boxes: Tensor, scores: Tensor, threshold: float, pre: int = 4096, post: int = 500) -> Tensor:
    """Keep the best boxes that do not overlap a better one; see :func:`beambox.ops.nms.nms`."""
    order = scores.argsort(descending=True, stable=True)[:pre]
    count = torch.full((1,), len(order), dtype=torch.int64, device=boxes.device)
    kept, number = nms_of_samples(boxes[order][None], count, threshold, min(post, len(order)))
    return order[kept[0, : int(number)]]


def nms_of_samples(boxes: Tensor, count: Tensor, threshold: float, post: int) -> tuple[Tensor, Tensor]:
    """Keep each sample's best boxes; see :func:`beambox.ops.nms.nms_of_samples`."""
    samples, places = boxes.shape[:2]
    words = triton.cdiv(places, 64)
    kept = torch.full((samples, post), -1, dtype=torch.int64, device=boxes.device)
    number = torch.zeros(samples, dtype=torch.int64, device=boxes.device)
    if samples and places and post:
        overlaps = torch.empty((samples, places, words), dtype=torch.int64, device=boxes.device)
        limit = constant((float(threshold),), boxes.device, torch.float64)  # as a number it would be float32
        prepared = prepare(boxes.reshape(-1, 7))
        grid = (triton.cdiv(places, ROWS), words, samples)
        _mark[grid](prepared, overlaps, count, places, words, limit, ROWS, num_warps=8)
        width = triton.next_power_of_2(words)
        _walk[(samples,)](overlaps, count, kept, number, places, words, post, width, num_warps=4 if width <= 64 else 8)
    return kept, number


@triton.jit
def _mark(boxes, overlaps, count, places, words, limit, rows: tl.constexpr):
    """Set bit j of word w of row i where boxes i and 64 w + j overlap by more than the limit; for words from i's on."""
    sample = tl.program_id(2).to(tl.int64)
    first, word = tl.program_id(0) * rows, tl.program_id(1)
    known = tl.load(count + sample)
    if (first < known) & (word * 64 < known) & (word * 64 + 63 > first):
        own = boxes + sample * places * 9
        row = first + tl.arange(0, rows)
        i = row[:, None]
        bit = tl.arange(0, 64)[None, :]
        j = word * 64 + bit
        shared = shared_area(own, i, i < known, own, j, j < known)  # (rows, 64)
        area_i = 4 * tl.load(own + i * 9 + 2, i < known, 0.0) * tl.load(own + i * 9 + 3, i < known, 0.0)
        area_j = 4 * tl.load(own + j * 9 + 2, j < known, 0.0) * tl.load(own + j * 9 + 3, j < known, 0.0)
        union = area_i + area_j - shared
        iou = tl.minimum(shared / tl.where(union > 0, union, 1.0), 1.0)
        over = (union > 0) & (iou > tl.load(limit))
        packed = tl.sum(tl.where(over, 1, 0).to(tl.int64) << bit.to(tl.int64), axis=1)  # (rows,)
        tl.store(overlaps + (sample * places + row) * words + word, packed, row < known)


@triton.jit
def _either(a, b):
    return a | b


@triton.jit
def _walk(overlaps, count, kept, number, places, words, post, width: tl.constexpr):
    """Write the rows that stay of one sample."""
    sample = tl.program_id(0).to(tl.int64)
    known = tl.load(count + sample)
    own = overlaps + sample * places * words
    row, word = tl.arange(0, 64), tl.arange(0, width)
    bit = row.to(tl.int64)
    ones = tl.full((64,), 1, tl.int64)
    after = (ones * -2) << bit  # the bits of those behind each row
    gone = tl.zeros((width,), tl.int64)
    found = tl.zeros((), tl.int64)
    block = tl.zeros((), tl.int64)
    while (block * 64 < known) & (found < post):
        rows = block * 64 + bit
        here = rows < known
        lost = tl.sum(tl.where(word == block, gone, 0), axis=0)
        alive = tl.where(here, (lost >> bit) & 1, 1) == 0  # (64,)
        behind = tl.load(own + rows * words + block, here, 0) & after  # those that each row would remove
        stays = tl.reduce(tl.where(alive, ones << bit, 0), 0, _either)
        changed = tl.full((), 1, tl.int32)
        while changed > 0:
            removed = tl.reduce(tl.where((stays >> bit) & 1 == 1, behind, 0), 0, _either)
            now = tl.reduce(tl.where(alive & ((removed >> bit) & 1 == 0), ones << bit, 0), 0, _either)
            changed = (now != stays).to(tl.int32)
            stays = now
        chosen = (stays >> bit) & 1
        place = found + tl.cumsum(chosen, axis=0) - 1
        tl.store(kept + sample * post + place, rows, (chosen == 1) & (place < post))
        found += tl.sum(chosen, axis=0)
        later = (word[None, :] > block) & (word[None, :] * 64 < known) & (chosen == 1)[:, None]
        removes = tl.load(own + rows[:, None] * words + word[None, :], later, 0)  # (64, width)
        gone = gone | tl.reduce(removes, 0, _either)
        block += 1
    tl.store(number + sample, tl.minimum(found, post))
