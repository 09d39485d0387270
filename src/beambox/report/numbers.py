"""AP by distance, occlusion and number of points; calibration of scores; confusion of classes; working points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beambox.metrics.matching import Counts, all_point_ap
from beambox.report.matching import Matches

__all__ = ["DISTANCES", "OCCLUSIONS", "POINTS", "Bin", "Calibration", "Confusion", "Group", "WorkingPoint"]
__all__ += ["calibration", "confusion", "groups", "precision_recall", "to_json", "working_point"]

Floats = NDArray[np.float64]

DISTANCES = (("0-20 m", 0.0, 20.0), ("20-40 m", 20.0, 40.0), ("40 m and farther", 40.0, math.inf))
"""Of the centre from the sensor over the ground, as the errors of the matched boxes have them."""
OCCLUSIONS = (("visible", 0, 1), ("partly occluded", 1, 2), ("largely occluded", 2, 3), ("unknown", 3, 4))
"""KITTI's states."""
POINTS = (("0-4", 0, 5), ("5-19", 5, 20), ("20-99", 20, 100), ("100-499", 100, 500), ("500 and more", 500, math.inf))
"""Points inside the labelled box."""
BINS = 10


@dataclass(frozen=True)
class Group:
    """How well one kind of objects is found."""

    by: str
    """``all``, ``distance``, ``occlusion`` or ``points``."""
    name: str
    objects: int
    """That count."""
    ap: float
    """Percent, over every recall that occurs; NaN without objects."""
    recall: float
    """Percent of the objects found at the class's working point."""


@dataclass(frozen=True)
class WorkingPoint:
    """The score threshold at which precision and recall are balanced best (largest F1)."""

    score: float
    precision: float
    """Percent."""
    recall: float
    """Percent."""
    f1: float
    """Percent."""


@dataclass(frozen=True)
class Bin:
    """Detections whose scores lie together."""

    low: float
    high: float
    right: int
    wrong: int
    mean_score: float
    """NaN where it is empty."""


@dataclass(frozen=True)
class Calibration:
    """How often detections of a score are right."""

    bins: tuple[Bin, ...]
    error: float
    """Expected calibration error: mean distance of score and precision over the detections, in percent (Guo et al.,
    ICML 2017)."""


@dataclass(frozen=True)
class Confusion:
    """Which class was detected where which was labelled, at the working points."""

    classes: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]
    """Rows: labelled classes, then background; columns: detected classes, then missed."""


def _tally(matches: Matches, name: str, of: NDArray[np.bool_], keep: NDArray[np.bool_]) -> Counts:
    """Count right and wrong detections of a class at each of its scores.

    Args:
        matches: of the evaluation.
        name: the class.
        of: ``(G,)`` objects that are asked about; the others are ignored, with what found them.
        keep: ``(D,)`` wrong detections that count.
    """
    truth, found = matches.truth, matches.found
    wanted = (truth.name == name) & truth.counts & of
    right = truth.score[wanted & ~np.isnan(truth.score)]
    wrong = found.score[(found.name == name) & keep & (found.kind != "right") & (found.kind != "ignored")]
    score = np.unique(np.concatenate((right, wrong)))[::-1]
    tp = np.searchsorted(np.sort(-right), -score, side="right").astype(np.float64)
    fp = np.searchsorted(np.sort(-wrong), -score, side="right").astype(np.float64)
    objects = int(wanted.sum())
    return Counts(score, tp, fp, objects - tp, np.zeros_like(tp), objects)


def precision_recall(matches: Matches, name: str) -> tuple[Floats, Floats]:
    """Return recall and interpolated precision of a class at each of its scores, best first, in [0, 1]."""
    counts = _tally(matches, name, np.ones(len(matches.truth.name), bool), np.ones(len(matches.found.name), bool))
    envelope = np.maximum.accumulate(counts.precision()[::-1])[::-1]
    return counts.tp / max(counts.objects, 1), envelope


def working_point(matches: Matches, name: str) -> WorkingPoint:
    """Find the score of largest F1; NaN where nothing is right."""
    counts = _tally(matches, name, np.ones(len(matches.truth.name), bool), np.ones(len(matches.found.name), bool))
    both = 2 * counts.tp + counts.fp + counts.fn
    f1 = np.divide(2 * counts.tp, both, out=np.zeros_like(both), where=both > 0)
    if not len(f1) or f1.max() <= 0:
        return WorkingPoint(math.nan, math.nan, math.nan, math.nan)
    best = int(f1.argmax())
    recall = counts.tp[best] / max(counts.objects, 1)
    return WorkingPoint(
        float(counts.score[best]), float(100 * counts.precision()[best]), float(100 * recall), float(100 * f1[best])
    )


def groups(matches: Matches, name: str) -> list[Group]:
    """Score the objects of a class in groups.

    Of the wrong detections all count in every group, but by distance those at that distance alone. A group of which
    nothing is known (points not counted, no occlusion labelled) is left out.
    """
    truth, found = matches.truth, matches.found
    threshold = working_point(matches, name).score
    every, all_found = np.ones(len(truth.name), bool), np.ones(len(found.name), bool)
    out = [_group(matches, name, "all", "all objects", every, all_found, threshold)]
    for label, low, high in DISTANCES:
        of, keep = ((each >= low) & (each < high) for each in (truth.distance, found.distance))
        out.append(_group(matches, name, "distance", label, of, keep, threshold))
    for by, column, kinds in (("occlusion", truth.occlusion, OCCLUSIONS), ("points", truth.points, POINTS)):
        if (column[truth.name == name] < 0).all():
            continue
        for label, low, high in kinds:
            out.append(_group(matches, name, by, label, (column >= low) & (column < high), all_found, threshold))
    return out


def _group(
    matches: Matches,
    name: str,
    by: str,
    label: str,
    of: NDArray[np.bool_],
    keep: NDArray[np.bool_],
    threshold: float,
) -> Group:
    counts = _tally(matches, name, of, keep)
    scores = matches.truth.score[(matches.truth.name == name) & matches.truth.counts & of]
    found = 0 if math.isnan(threshold) else int((scores >= threshold).sum())
    recall = 100 * found / len(scores) if len(scores) else math.nan
    return Group(by, label, counts.objects, all_point_ap(counts, counts.precision()), recall)


def calibration(matches: Matches, name: str) -> Calibration:
    """Compare scores with the share of right detections, in ten bins of score."""
    found = matches.found
    mine = (found.name == name) & (found.kind != "ignored")
    score, right = found.score[mine], found.kind[mine] == "right"
    place = np.clip((score * BINS).astype(np.int64), 0, BINS - 1)
    bins, error = [], 0.0
    for k in range(BINS):
        inside = place == k
        hits, size = int(right[inside].sum()), int(inside.sum())
        mean = float(score[inside].mean()) if size else math.nan
        bins.append(Bin(k / BINS, (k + 1) / BINS, hits, size - hits, mean))
        error += abs(mean * size - hits) if size else 0.0
    return Calibration(tuple(bins), 100 * error / len(score) if len(score) else math.nan)


def confusion(matches: Matches) -> Confusion:
    """Count labelled classes against detected ones, above each class's working point."""
    classes, truth, found = matches.classes, matches.truth, matches.found
    thresholds = {name: working_point(matches, name).score for name in classes}
    least = np.array([thresholds[name] for name in found.name], dtype=np.float64)
    taken = (found.score >= least) & (found.kind != "ignored")
    size = len(classes)
    counts = np.zeros((size + 1, size + 1), dtype=np.int64)
    for i, name in enumerate(classes):
        mine = (truth.name == name) & truth.counts
        caught = mine & (truth.score >= thresholds[name])
        counts[i, i] = int(caught.sum())
        for j, other in enumerate(classes):
            if i != j:
                counts[i, j] = int(
                    (taken & (found.name == other) & (found.about == name) & (found.kind == "wrong class")).sum()
                )
        counts[i, size] = int(mine.sum()) - counts[i, i]
        wrong = taken & (found.name == name) & (found.kind != "right")
        counts[size, i] = int(wrong.sum()) - int(
            (wrong & (found.kind == "wrong class") & np.isin(found.about, classes)).sum()
        )
    return Confusion(classes, tuple(map(tuple, counts.tolist())))


def to_json(matches: Matches, classes: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of each class ready for ``json.dump``; null where there is none."""
    out: dict[str, Any] = {}
    for name in classes:
        point, scores = working_point(matches, name), calibration(matches, name)
        out[name] = {
            "working_point": {key: _number(value) for key, value in vars(point).items()},
            "groups": [
                {"by": g.by, "name": g.name, "objects": g.objects, "ap": _number(g.ap), "recall": _number(g.recall)}
                for g in groups(matches, name)
            ],
            "calibration": {
                "error": _number(scores.error),
                "bins": [{key: _number(value) for key, value in vars(each).items()} for each in scores.bins],
            },
        }
    return out


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)
