"""Scores of tracks: HOTA, the CLEAR MOT metrics and AMOTA, from identities and overlaps alone.

* HOTA: Luiten et al., IJCV 2021; averaged over 19 localisation thresholds 0.05 to 0.95.
* MOTA, MOTP, identity switches, fragments: Bernardin and Stiefelhagen, 2008; mostly tracked and lost: 80 and 20 %.
* AMOTA and sAMOTA: Weng et al., IROS 2020; 40 recalls. A track's score is the mean of its detections'.

Counts follow the definitions that the benchmarks' programs share; tests compare with TrackEval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError, import_library

__all__ = ["ClearScores", "HotaScores", "TrackingFrame", "amota", "assign", "clear_mot", "hota"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
ALPHAS = np.arange(1, 20) / 20
RECALLS = np.arange(1, 41) / 40
CONTINUED = 1000.0
"""Weight that keeps a pair together which was one before: larger than any sum of overlaps."""


@dataclass(frozen=True)
class TrackingFrame:
    """What one frame contributes; G labelled objects, N tracked ones."""

    gt_ids: Integers
    """``(G,)`` identities, unique among all frames scored together."""
    ids: Integers
    """``(N,)`` likewise."""
    overlap: Floats
    """``(G, N)`` in [0, 1]."""
    scores: Floats
    """``(N,)``."""


@dataclass(frozen=True)
class HotaScores:
    """Shares in [0, 1], averaged over the localisation thresholds."""

    hota: float
    det_a: float
    """Detection accuracy TP / (TP + FN + FP)."""
    ass_a: float
    """Association accuracy."""
    loc_a: float
    """Mean overlap of matched pairs."""


@dataclass(frozen=True)
class ClearScores:
    """Counts, and what follows from them."""

    tp: int
    fp: int
    fn: int
    switches: int
    """Times that a labelled object is matched by another identity than last."""
    fragments: int
    """Times that a labelled object is found again after it was lost."""
    mostly_tracked: int
    """Labelled objects found in more than 80 % of their frames."""
    mostly_lost: int
    """Labelled objects found in less than 20 % of their frames."""
    objects: int
    """Number of labelled identities."""
    overlap: float
    """Sum over matched pairs."""

    @property
    def mota(self) -> float:
        """1 - (FP + FN + switches) / objects in all frames; NaN without any."""
        total = self.tp + self.fn
        return 1 - (self.fp + self.fn + self.switches) / total if total else float("nan")

    @property
    def motp(self) -> float:
        """Mean overlap of matched pairs; NaN without any."""
        return self.overlap / self.tp if self.tp else float("nan")


def hota(frames: Sequence[TrackingFrame]) -> HotaScores:
    """Score detection and association together."""
    gt_index, gt_count = _index([frame.gt_ids for frame in frames])
    index, count = _index([frame.ids for frame in frames])
    aligned = np.zeros((len(gt_count), len(count)))
    for frame, rows, columns in zip(frames, gt_index, index):
        together = frame.overlap.sum(axis=1)[:, None] + frame.overlap.sum(axis=0)[None] - frame.overlap
        aligned[np.ix_(rows, columns)] += _ratio(frame.overlap, together)
    aligned = _ratio(aligned, gt_count[:, None] + count[None] - aligned)
    pairs = np.zeros((len(ALPHAS), len(gt_count), len(count)))
    overlaps = np.zeros(len(ALPHAS))
    for frame, rows, columns in zip(frames, gt_index, index):
        left, right = assign(aligned[np.ix_(rows, columns)] * frame.overlap)
        quality = frame.overlap[left, right]
        for k, alpha in enumerate(ALPHAS):
            keep = quality >= alpha - 1e-12
            pairs[k, rows[left[keep]], columns[right[keep]]] += 1
            overlaps[k] += quality[keep].sum()
    tp = pairs.sum(axis=(1, 2))
    union = gt_count[:, None] + count[None] - pairs
    association = _ratio((pairs * _ratio(pairs, union)).sum(axis=(1, 2)), tp)
    detection = _ratio(tp, gt_count.sum() + count.sum() - tp)
    location = np.where(tp > 0, _ratio(overlaps, tp), 1.0)
    return HotaScores(
        float(np.sqrt(detection * association).mean()),
        float(detection.mean()),
        float(association.mean()),
        float(location.mean()),
    )


def clear_mot(frames: Sequence[TrackingFrame], min_overlap: float) -> ClearScores:
    """Count matches, misses, false positives and switches; a pair stays one while it overlaps enough.

    Args:
        frames: in order of time; of several drives one after the other, with identities of their own.
        min_overlap: a pair may match from this overlap on.
    """
    if not 0 < min_overlap <= 1:
        raise BeamboxError(f"`min_overlap` must lie in (0, 1], got {min_overlap}")
    last: dict[int, int] = {}
    pairs: dict[int, int] = {}  # of the frame before
    present: dict[int, int] = {}
    found: dict[int, int] = {}
    before: set[int] = set()
    fragments: dict[int, int] = {}
    tp = fp = switches = 0
    total = 0.0
    for frame in frames:
        known = np.array([[pairs.get(g, -1) == t for t in frame.ids] for g in frame.gt_ids.tolist()], dtype=bool)
        known = known.reshape(frame.overlap.shape)
        enough = frame.overlap >= min_overlap - 1e-12
        left, right = assign(np.where(enough, frame.overlap + CONTINUED * known, 0.0))
        keep = enough[left, right]
        left, right = left[keep], right[keep]
        for g in frame.gt_ids.tolist():
            present[g] = present.get(g, 0) + 1
        pairs = dict(zip(frame.gt_ids[left].tolist(), frame.ids[right].tolist()))
        for g, t in pairs.items():
            switches += g in last and last[g] != t
            if g not in before:
                fragments[g] = fragments.get(g, 0) + 1
            last[g] = t
            found[g] = found.get(g, 0) + 1
        # an object that is not labelled in a frame is neither found nor lost there
        before = set(pairs) | (before - set(frame.gt_ids.tolist()))
        tp += len(left)
        fp += len(frame.ids) - len(left)
        total += float(frame.overlap[left, right].sum())
    share = [found.get(g, 0) / count for g, count in present.items()]
    return ClearScores(
        tp=tp,
        fp=fp,
        fn=sum(present.values()) - tp,
        switches=switches,
        fragments=sum(times - 1 for times in fragments.values()),
        mostly_tracked=sum(one > 0.8 for one in share),
        mostly_lost=sum(one < 0.2 for one in share),
        objects=len(present),
        overlap=total,
    )


def amota(frames: Sequence[TrackingFrame], min_overlap: float) -> tuple[float, float]:
    """Average MOTA over recalls: the worth of a tracker whose threshold nobody has tuned.

    Returns:
        AMOTA, the mean of MOTA at 40 recalls, and sAMOTA, where each MOTA is scaled by what its recall lets it reach
        and is at least 0. A recall that is not reached counts 0. NaN without labelled objects.
    """
    objects = sum(len(frame.gt_ids) for frame in frames)
    if objects == 0:
        return float("nan"), float("nan")
    scores = _track_scores(frames)
    levels = sorted(set(scores.values()), reverse=True)
    counted: dict[float, ClearScores] = {}

    def at(level: float) -> ClearScores:
        if level not in counted:
            kept = [_above(frame, scores, level) for frame in frames]
            counted[level] = clear_mot(kept, min_overlap)
        return counted[level]

    plain, scaled, k = [], [], 0
    for recall in RECALLS:
        while k < len(levels) and at(levels[k]).tp < recall * objects - 1e-9:
            k += 1
        if k == len(levels):
            plain.append(0.0)
            scaled.append(0.0)
            continue
        counts = at(levels[k])
        wrong = counts.fp + counts.fn + counts.switches
        plain.append(1 - wrong / objects)
        scaled.append(min(1.0, max(0.0, 1 - (wrong - (1 - recall) * objects) / (recall * objects))))
    return float(np.mean(plain)), float(np.mean(scaled))


def _track_scores(frames: Sequence[TrackingFrame]) -> dict[int, float]:
    ids = np.concatenate([frame.ids for frame in frames]) if frames else np.zeros(0, dtype=np.int64)
    scores = np.concatenate([frame.scores for frame in frames]) if frames else np.zeros(0)
    known, place, count = np.unique(ids, return_inverse=True, return_counts=True)
    means = np.bincount(place, weights=scores, minlength=len(known)) / np.maximum(count, 1)
    return dict(zip(known.tolist(), means.tolist()))


def _above(frame: TrackingFrame, scores: dict[int, float], level: float) -> TrackingFrame:
    keep = np.array([scores[t] >= level for t in frame.ids.tolist()], dtype=bool)
    return TrackingFrame(frame.gt_ids, frame.ids[keep], frame.overlap[:, keep], frame.scores[keep])


def _index(ids: Sequence[Integers]) -> tuple[list[NDArray[np.intp]], Floats]:
    """Number identities from 0; return them frame by frame, and how often each occurs."""
    joined = np.concatenate(ids) if ids else np.zeros(0, dtype=np.int64)
    _, place, count = np.unique(joined, return_inverse=True, return_counts=True)
    ends = np.cumsum([len(one) for one in ids])[:-1]
    return np.split(place, ends), count.astype(np.float64)


def _ratio(part: Floats, whole: Floats) -> Floats:
    return np.divide(part, whole, out=np.zeros_like(part, dtype=np.float64), where=whole > 1e-12)


def assign(gain: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair rows and columns so that the sum of gains is largest."""
    if not gain.size:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    return import_library("scipy.optimize", "track", "scoring tracks").linear_sum_assignment(-gain)
