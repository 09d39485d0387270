"""Everything that one evaluation measured: official scores, errors, matches, and what it was made with."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beambox.infer.evaluate import merged_classes, score_frames, score_once
from beambox.metrics.box_errors import box_errors
from beambox.metrics.box_errors_result import BoxErrors
from beambox.metrics.kitti import KittiFrame
from beambox.metrics.kitti_result import KittiResult
from beambox.metrics.once_result import OnceResult
from beambox.ops.points_in_boxes import points_in_boxes_mask
from beambox.report import numbers
from beambox.report.matching import Matches, match_frames
from beambox.structures import Detections, Frame

__all__ = ["Measured", "PointCounts", "TimedDetect", "measure"]


@dataclass(frozen=True)
class Measured:
    """One evaluation."""

    name: str
    """Of the detector, or of the folder of results."""
    frames: Sequence[KittiFrame]
    """Labels and detections, in order; classes as they are scored."""
    scored: KittiResult | OnceResult
    errors: BoxErrors
    matches: Matches
    about: Mapping[str, Any] = field(default_factory=dict)
    """What it was made with: versions, device, latency, card; plain values."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes scored."""
        return self.matches.classes

    def to_json(self) -> dict[str, Any]:
        """Return all numbers ready for ``json.dump``."""
        table = numbers.confusion(self.matches)
        return {
            "name": self.name,
            "frames": len(self.frames),
            "metric": "once" if isinstance(self.scored, OnceResult) else "kitti",
            "ap": self.scored.to_json(),
            "errors": self.errors.to_json(),
            "classes": numbers.to_json(self.matches, self.classes),
            "confusion": {"classes": list(table.classes), "counts": [list(row) for row in table.counts]},
            "about": dict(self.about),
        }


def measure(
    name: str,
    frames: Sequence[KittiFrame],
    classes: Sequence[str],
    *,
    by_once: bool = False,
    levels: bool = True,
    points: Sequence[NDArray[np.int64]] | None = None,
    about: Mapping[str, Any] | None = None,
) -> Measured:
    """Measure an evaluation.

    Args:
        name: what to call it.
        frames: from :func:`beambox.infer.evaluate.scored_frames`.
        classes: to score, by the labels' names.
        by_once: by ONCE's rules, Car, Bus and Truck merged into Vehicle, instead of KITTI's.
        levels: False scores all objects together, without KITTI's difficulty.
        points: points in each labelled box, one array a frame; from :class:`PointCounts`.
        about: what it was made with.
    """
    if by_once:
        scored: KittiResult | OnceResult = score_once(frames, known=classes)
        frames = [merged_classes(frame) for frame in frames]
        thresholds = dict(zip(scored.classes, scored.iou))  # pyright: ignore[reportAttributeAccessIssue]
    else:
        scored = score_frames(frames, classes, levels=levels)
        thresholds = {each.name: each.iou for each in scored.classes}
    matches = match_frames(frames, thresholds, points)
    return Measured(name, frames, scored, box_errors(frames, list(thresholds)), matches, about or {})


class PointCounts:
    """Counts the points in each labelled box while frames pass by on their way to the metrics, which keep no points."""

    def __init__(self) -> None:
        self.counts: list[NDArray[np.int64]] = []

    def watch(self, found: Iterable[tuple[Frame, Detections]]) -> Iterator[tuple[Frame, Detections]]:
        """Hand on frames and their detections, as they come."""
        for frame, detections in found:
            if frame.labels is not None:
                inside = points_in_boxes_mask(frame.points, frame.labels.boxes)  # (N, points)
                self.counts.append(inside.sum(dim=1).numpy())
            yield frame, detections


class TimedDetect:
    """Times a detector call by call; the first calls, which compile and fill caches, are left out of the summary."""

    WARMUP = 3

    def __init__(self, detect: Callable[[Sequence[Frame]], list[Detections]]) -> None:
        self._detect = detect
        self._seconds: list[float] = []

    def __call__(self, frames: Sequence[Frame]) -> list[Detections]:
        """Detect."""
        start = time.perf_counter()
        found = self._detect(frames)
        self._seconds.append((time.perf_counter() - start) / max(1, len(frames)))
        return found

    def summary(self) -> dict[str, float]:
        """Return milliseconds per frame: median and 90th percentile, and how many calls they are of."""
        kept = self._seconds[self.WARMUP :] or self._seconds
        if not kept:
            return {}
        p90 = float(np.quantile(kept, 0.9))
        values = {"median": 1000 * statistics.median(kept), "p90": 1000 * p90, "calls": len(kept)}
        return {key: round(value, 2) for key, value in values.items() if not math.isnan(value)}
