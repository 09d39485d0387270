"""Matching detections with ground truth, and the counts behind a precision-recall curve; shared by KITTI and ONCE.

Both benchmarks flag every box: 0 counts, 1 is ignored (it may absorb a partner, and nothing is counted), -1 takes no
part. For a score threshold, the ground truth of a frame chooses, in file order, among the detections that are left.
Counting all frames anew for every threshold is slow; here each frame tells at which of its own scores its counts
change, and one sort of those changes gives the counts at every threshold there is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["Counts", "MatchTable", "all_point_ap", "count", "sampled_precision", "true_positive_scores"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class MatchTable:
    """Flags, scores and overlaps of one class under one metric; the boxes of all frames stand in one row.

    Ground truth of frame f lies in ``gt_start[f]:gt_start[f + 1]``, detections in ``det_start[...]`` likewise,
    and their overlaps in ``overlap[pair_start[f]:pair_start[f + 1]]``, ground truth by detections, row after row.
    """

    gt_start: Integers
    """``(F + 1,)``."""
    det_start: Integers
    """``(F + 1,)``."""
    pair_start: Integers
    """``(F + 1,)``."""
    overlap: Floats
    """``(P,)`` in [0, 1]."""
    min_overlap: float
    """A pair matches where its overlap is greater."""
    gt_flag: Integers
    """``(G,)`` 0 counts, 1 ignored, -1 takes no part."""
    det_flag: Integers
    """``(D,)`` likewise."""
    score: Floats
    """``(D,)``."""
    dontcare: NDArray[np.bool_]
    """``(D,)`` detections that are no false positives where nothing matches them (KITTI's DontCare regions)."""
    gt_alpha: Floats
    """``(G,)`` observation angles, radians; zeros where no orientation is scored."""
    det_alpha: Floats
    """``(D,)`` likewise."""

    @property
    def objects(self) -> int:
        """Number of ground-truth boxes that count."""
        return int((self.gt_flag == 0).sum())


@dataclass(frozen=True)
class Counts:
    """What is counted when all detections with at least a given score are kept; one row per score, best first."""

    score: Floats
    """``(K,)`` strictly descending."""
    tp: Floats
    """``(K,)`` true positives."""
    fp: Floats
    """``(K,)`` false positives."""
    fn: Floats
    """``(K,)`` misses."""
    similarity: Floats
    """``(K,)`` sum of (1 + cos of the heading's error) / 2 over the true positives."""
    objects: int
    """Number of ground-truth boxes that count."""

    def precision(self) -> Floats:
        """Return TP / (TP + FP), ``(K,)``; 0 where nothing is counted."""
        return _ratio(self.tp, self.tp + self.fp)

    def oriented_precision(self) -> Floats:
        """Return the similarity over TP + FP (KITTI's AOS curve), ``(K,)``."""
        return _ratio(self.similarity, self.tp + self.fp)


def _ratio(part: Floats, whole: Floats) -> Floats:
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)


def true_positive_scores(table: MatchTable) -> Floats:
    """Match with the highest score instead of the largest overlap and return the scores of what counts, descending.

    This is the first pass of both benchmarks: their score thresholds are chosen among these.
    """
    scores = _first_pass(
        table.gt_start,
        table.det_start,
        table.pair_start,
        table.overlap,
        table.min_overlap,
        table.gt_flag,
        table.det_flag,
        table.score,
    )
    return np.sort(scores)[::-1]


def count(table: MatchTable) -> Counts:
    """Count true positives, false positives and misses at every distinct score."""
    changes = np.zeros((len(table.score), 4))
    _second_pass(
        table.gt_start,
        table.det_start,
        table.pair_start,
        table.overlap,
        table.min_overlap,
        table.gt_flag,
        table.det_flag,
        table.score,
        table.dontcare,
        table.gt_alpha,
        table.det_alpha,
        changes,
    )
    order = np.argsort(-table.score, kind="stable")
    score = table.score[order]
    last = np.flatnonzero(np.append(score[1:] != score[:-1], True)) if len(score) else np.zeros(0, dtype=np.int64)
    tp, fp, fn, similarity = np.cumsum(changes[order], axis=0)[last].T  # (K,) each
    return Counts(score[last], tp, fp, table.objects + fn, similarity, table.objects)


def sampled_precision(counts: Counts, curve: Floats, thresholds: Floats, size: int) -> Floats:
    """Read a curve at score thresholds and make it non-increasing from the back.

    Args:
        counts: whose scores the curve belongs to.
        curve: ``(K,)`` precision at ``counts.score``.
        thresholds: at most ``size`` scores, descending.
        size: number of entries; those without a threshold are 0.

    Returns:
        ``(size,)``.
    """
    sampled = np.zeros(size)
    if len(counts.score):
        place = np.searchsorted(-counts.score, -np.asarray(thresholds), side="right") - 1
        sampled[: len(thresholds)] = np.where(place >= 0, curve[place], 0.0)
    return np.maximum.accumulate(sampled[::-1])[::-1]


def all_point_ap(counts: Counts, curve: Floats) -> float:
    """Return the area under the interpolated curve over every recall that occurs, in percent; NaN without objects."""
    if counts.objects == 0:
        return float("nan")
    envelope = np.maximum.accumulate(curve[::-1])[::-1]
    recall = counts.tp / counts.objects
    return float(100 * (np.diff(recall, prepend=0.0) * envelope).sum())


@njit(cache=True)
def _first_pass(gt_start, det_start, pair_start, overlap, min_overlap, gt_flag, det_flag, score):  # pragma: no cover
    out = np.empty(len(score))
    size = 0
    for frame in range(len(gt_start) - 1):
        first, number = det_start[frame], det_start[frame + 1] - det_start[frame]
        taken = np.zeros(number, dtype=np.bool_)
        for gt in range(gt_start[frame], gt_start[frame + 1]):
            if gt_flag[gt] < 0:
                continue
            row = pair_start[frame] + (gt - gt_start[frame]) * number
            chosen = -1
            for j in range(number):
                if taken[j] or det_flag[first + j] < 0 or not overlap[row + j] > min_overlap:
                    continue
                if chosen < 0 or score[first + j] > score[first + chosen]:
                    chosen = j
            if chosen < 0:
                continue
            taken[chosen] = True
            if gt_flag[gt] == 0 and det_flag[first + chosen] == 0:
                out[size] = score[first + chosen]
                size += 1
    return out[:size]


@njit(cache=True)
def _second_pass(
    gt_start,
    det_start,
    pair_start,
    overlap,
    min_overlap,
    gt_flag,
    det_flag,
    score,
    dontcare,
    gt_alpha,
    det_alpha,
    changes,
):  # pragma: no cover
    """Write into ``changes[d]`` how TP, FP, FN and similarity change when the threshold falls to ``score[d]``."""
    for frame in range(len(gt_start) - 1):
        gts = slice(gt_start[frame], gt_start[frame + 1])
        dets = slice(det_start[frame], det_start[frame + 1])
        gt_flags, det_flags, scores = gt_flag[gts], det_flag[dets], score[dets]
        pairs = overlap[pair_start[frame] : pair_start[frame + 1]].reshape(len(gt_flags), len(det_flags))
        candidates = _candidates(pairs, min_overlap, gt_flags, det_flags)
        alone = np.ones(len(scores), dtype=np.bool_)
        alone[candidates] = False
        for j in range(len(scores)):
            if alone[j] and det_flags[j] == 0 and not dontcare[dets][j]:
                changes[dets][j, 1] += 1.0
        order = np.argsort(-scores[candidates])
        before = np.zeros(4)
        for k in range(len(candidates)):
            last = candidates[order[k]]
            if k + 1 < len(candidates) and scores[candidates[order[k + 1]]] == scores[last]:
                continue
            after = _match_frame(
                pairs,
                min_overlap,
                gt_flags,
                det_flags,
                scores,
                dontcare[dets],
                gt_alpha[gts],
                det_alpha[dets],
                candidates,
                scores[last],
            )
            changes[dets][last] += after - before
            before = after


@njit(cache=True)
def _candidates(pairs, min_overlap, gt_flag, det_flag):  # pragma: no cover
    """Return the detections of a frame that could match something, in file order."""
    keep = np.zeros(len(det_flag), dtype=np.bool_)
    for i in range(len(gt_flag)):
        for j in range(len(det_flag)):
            if gt_flag[i] >= 0 and det_flag[j] >= 0 and pairs[i, j] > min_overlap:
                keep[j] = True
    return np.flatnonzero(keep)


@njit(cache=True)
def _match_frame(
    pairs, min_overlap, gt_flag, det_flag, score, dontcare, gt_alpha, det_alpha, candidates, threshold
):  # pragma: no cover
    """Match one frame at one threshold by overlap; TP, FP, FN less the number of objects, similarity."""
    counted = np.zeros(4)
    taken = score[candidates] < threshold  # those below the threshold take no part
    for i in range(len(gt_flag)):
        if gt_flag[i] < 0:
            continue
        chosen, largest, chosen_ignored = -1, 0.0, False
        for k in range(len(candidates)):
            j = candidates[k]
            if taken[k] or not pairs[i, j] > min_overlap:
                continue
            if det_flag[j] == 0:
                if pairs[i, j] > largest or chosen_ignored:
                    chosen, largest, chosen_ignored = k, pairs[i, j], False
            elif chosen < 0:
                chosen, chosen_ignored = k, True
        if chosen < 0:
            continue
        taken[chosen] = True
        if gt_flag[i] == 0:
            counted[2] -= 1.0
            if not chosen_ignored:
                counted[0] += 1.0
                counted[3] += (1.0 + np.cos(gt_alpha[i] - det_alpha[candidates[chosen]])) / 2.0
    for k in range(len(candidates)):
        j = candidates[k]
        if not taken[k] and det_flag[j] == 0 and not dontcare[j]:
            counted[1] += 1.0
    return counted
