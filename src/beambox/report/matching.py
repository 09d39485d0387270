"""Every object and every detection of an evaluation with what became of it: found, missed, misplaced, made up.

AP says how good a detector is; this says where it fails. Detections of a class, best first, each take the free object
of largest 3-D IoU, where that exceeds the class's threshold. What KITTI ignores is ignored here too: objects beyond the
hard level, neighbouring classes, detections below 25 pixels, and those in regions that nobody labelled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beambox.metrics.box_errors import countable, greedy_pairs
from beambox.metrics.kitti import LEVELS, NEIGHBOR, KittiFrame
from beambox.metrics.kitti_objects import objects_from_detections
from beambox.metrics.overlap import covered_share, rotated_overlaps

__all__ = ["KINDS", "Found", "Matches", "Truth", "match_frames"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

KINDS = ("right", "ignored", "duplicate", "misplaced", "wrong class", "background")
"""What a detection is: right; one of nothing that counts; a second one of an object; of an object, but elsewhere; of an
object of another class; of nothing that is labelled."""
NEAR_SHARE = 0.2
"""Share of the smaller of two boxes, in BEV, that both cover, from which a detection is about an object."""
SPARED_SHARE = 0.5
"""Share of a detection's image box in an unlabelled region from which it is ignored."""


class Truth(NamedTuple):
    """Labelled objects of all frames, one row each."""

    frame: Integers
    """Position of the frame."""
    row: Integers
    """Position in the frame's labels."""
    name: NDArray[np.str_]
    """Class, as scored."""
    counts: NDArray[np.bool_]
    """False: ignored."""
    distance: Floats
    """Metres from the sensor over the ground."""
    occlusion: Integers
    """KITTI's state, 0 to 3; -1 where it is not known."""
    points: Integers
    """Points in the box; -1 where they were not counted."""
    score: Floats
    """Of the detection that found it; NaN where it was missed."""


class Found(NamedTuple):
    """Detections of all frames, one row each."""

    frame: Integers
    """Position of the frame."""
    row: Integers
    """Position in the frame's detections."""
    name: NDArray[np.str_]
    """Class, as scored."""
    score: Floats
    distance: Floats
    """Metres from the sensor over the ground."""
    kind: NDArray[np.str_]
    """One of ``KINDS``."""
    iou: Floats
    """Largest 3-D IoU with an object of its class."""
    about: NDArray[np.str_]
    """Class of the object it covers most of, whatever its class; empty below ``NEAR_SHARE``."""


TRUTH_TYPES = (np.int64, np.int64, np.str_, np.bool_, np.float64, np.int64, np.int64, np.float64)
FOUND_TYPES = (np.int64, np.int64, np.str_, np.float64, np.float64, np.str_, np.float64, np.str_)


@dataclass(frozen=True)
class Matches:
    """What became of everything."""

    truth: Truth
    found: Found
    thresholds: Mapping[str, float]
    """3-D IoU that makes a detection right, by class; also the classes and their order."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes that were looked at."""
        return tuple(self.thresholds)


def match_frames(
    frames: Sequence[KittiFrame], thresholds: Mapping[str, float], points: Sequence[Integers] | None = None
) -> Matches:
    """Match detections with objects.

    Args:
        frames: labels and detections, both in the sensor's frame.
        thresholds: 3-D IoU above which a detection is right, by class; other classes are left out.
        points: points in each labelled box, one array a frame, where they were counted.
    """
    known = {name.lower(): name for name in thresholds}
    truths: list[tuple] = []
    founds: list[tuple] = []
    for number, frame in enumerate(frames):
        inside = None if points is None else points[number]
        _match_frame(number, frame, known, thresholds, inside, truths, founds)
    return Matches(Truth(*_columns(truths, TRUTH_TYPES)), Found(*_columns(founds, FOUND_TYPES)), dict(thresholds))


def _match_frame(
    number: int,
    frame: KittiFrame,
    known: Mapping[str, str],
    thresholds: Mapping[str, float],
    points: Integers | None,
    truths: list[tuple],
    founds: list[tuple],
) -> None:
    labels, found = frame.labels, frame.detections
    truth, boxes = labels.boxes.double().numpy(), found.boxes.detach().cpu().double().numpy()
    bev, box3d = rotated_overlaps(truth, boxes)  # (N, M) each
    area, areas = truth[:, 3] * truth[:, 4], boxes[:, 3] * boxes[:, 4]
    shared = bev * (area[:, None] + areas) / (1 + bev)  # from the IoU back to square metres
    smaller = np.minimum(area[:, None], areas)
    near = np.divide(shared, smaller, out=np.zeros_like(bev), where=smaller > 0)
    counts, spared = countable(labels), _spared(frame)
    truth_names, found_names = (
        np.array([n.lower() for n in names], dtype=np.str_) for names in (labels.names, found.names)
    )
    scores = found.scores.detach().cpu().double().numpy()
    score_of, kinds = np.full(len(truth), np.nan), np.full(len(boxes), "background", dtype="<U12")
    for key, name in known.items():
        rows, columns = np.flatnonzero(truth_names == key), np.flatnonzero(found_names == key)
        columns = columns[np.argsort(-scores[columns], kind="stable")]
        own3d, own_near = box3d[np.ix_(rows, columns)], near[np.ix_(rows, columns)]
        neighbors = np.flatnonzero(truth_names == NEIGHBOR.get(key, ""))
        others = np.flatnonzero((truth_names != key) & (truth_names != NEIGHBOR.get(key, "")))
        partner = {column: row for row, column in greedy_pairs(own3d, thresholds[name])}
        for place, column in enumerate(columns):
            if place in partner:
                row = rows[partner[place]]
                score_of[row] = scores[column]
                kinds[column] = "right" if counts[row] else "ignored"
            elif spared[column] or (box3d[neighbors, column] > thresholds[name]).any():
                kinds[column] = "ignored"
            elif (own3d[:, place] > thresholds[name]).any():
                kinds[column] = "duplicate"
            elif (own_near[:, place] > NEAR_SHARE).any():
                kinds[column] = "misplaced"
            elif (near[others, column] > NEAR_SHARE).any():
                kinds[column] = "wrong class"
    distance = [np.hypot(each[:, 0], each[:, 1]) for each in (truth, boxes)]
    occlusion = np.full(len(truth), -1) if labels.attributes is None else labels.attributes.occlusion.long().numpy()
    for row, key in enumerate(truth_names):
        if key in known:
            num_points = -1 if points is None else int(points[row])
            truths.append(
                (number, row, known[key], counts[row], distance[0][row], occlusion[row], num_points, score_of[row])
            )
    for column, key in enumerate(found_names):
        if key in known:
            mine = box3d[truth_names == key, column]
            nearest = int(near[:, column].argmax()) if len(truth) else 0
            about = str(labels.names[nearest]) if len(truth) and near[nearest, column] > NEAR_SHARE else ""
            founds.append(
                (number, column, known[key], scores[column], distance[1][column], kinds[column],
                 mine.max(initial=0.0), known.get(about.lower(), about))
            )  # fmt: skip


def _spared(frame: KittiFrame) -> NDArray[np.bool_]:
    """Tell which detections KITTI would not look at: below the least height, or where nobody labelled."""
    found = frame.detections
    if frame.calibration is None or frame.labels.attributes is None:
        return np.zeros(len(found), dtype=np.bool_)
    image = objects_from_detections(found, frame.calibration, frame.image_size).image  # (M, 4)
    low = np.trunc(np.abs(image[:, 3] - image[:, 1])) < LEVELS[-1].min_height
    return low | (covered_share(image, frame.labels.ignored_image.double().numpy()) > SPARED_SHARE)


def _columns(rows: list[tuple], types: Sequence[type]) -> list[NDArray]:
    columns = list(zip(*rows)) if rows else [()] * len(types)
    return [np.array(column, dtype=kind) for column, kind in zip(columns, types)]
