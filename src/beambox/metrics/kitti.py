"""KITTI's object detection benchmark: average precision in the image, in BEV, in 3-D, and with orientation.

The algorithm is that of the official C++ evaluator (KITTI devkit, ``evaluate_object``), for each class, difficulty and
metric:

1. flag every box: counts, ignored (too small, too hidden, a neighbouring class) or of no concern;
2. match once by score; the scores of what matches, at up to 41 steps of recall, become the thresholds;
3. match again by overlap at each threshold and read the precision;
4. AP is the mean of the interpolated precision over 40 recalls (R40, official since October 2019) or 11 (R11, before).

Because step 2 yields at most one threshold an object, R40 and R11 of a set with fewer than 41 objects stay below 100
even if everything is right: 4 cars, all found, give 7.5. ``all`` is the area under the same curve over every recall
that occurs, without that limit; read it on small sets.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError, did_you_mean
from beambox.geometry.calibration import Calibration
from beambox.metrics.kitti_objects import Objects, objects_from_detections, objects_from_labels, read_pairs
from beambox.metrics.kitti_result import AveragePrecision, ClassResult, KittiResult
from beambox.metrics.matching import (
    Counts,
    MatchTable,
    all_point_ap,
    count,
    sampled_precision,
    true_positive_scores,
)
from beambox.metrics.overlap import covered_share, image_overlap, rotated_overlaps, starts
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = ["CLASSES", "DEFAULT_OVERLAP", "KittiFrame", "KittiResult", "evaluate", "evaluate_files", "score_thresholds"]

Floats = NDArray[np.float64]

CLASSES = ("Car", "Pedestrian", "Cyclist")
"""The classes of the benchmark."""
DEFAULT_OVERLAP = {
    "car": 0.7,
    "van": 0.7,
    "truck": 0.7,
    "bus": 0.7,
    "tram": 0.7,
    "vehicle": 0.7,
    "pedestrian": 0.5,
    "person_sitting": 0.5,
    "cyclist": 0.5,
}
"""IoU above which a detection matches; KITTI names those of its three classes, the others follow them."""
NEIGHBOR = {"car": "van", "pedestrian": "person_sitting"}
"""A class that is neither right nor wrong to detect."""
SAMPLES = 41


class Difficulty(NamedTuple):
    """Who counts at one level; everybody harder is ignored."""

    name: str
    min_height: float  # of the image box, pixels
    max_occlusion: float
    max_truncation: float


LEVELS = (
    Difficulty("easy", 40, 0, 0.15),
    Difficulty("moderate", 25, 1, 0.30),
    Difficulty("hard", 25, 2, 0.50),
)
EVERYBODY = (Difficulty("all objects", -np.inf, np.inf, np.inf),)


class KittiFrame(NamedTuple):
    """One frame to score from memory; a plain tuple (labels, detections, calibration) serves as well."""

    labels: Labels
    detections: Detections
    calibration: Calibration | None = None
    image_size: tuple[int, int] = (1242, 375)
    """(width, height) in pixels, to which the image boxes of the detections are clipped."""


def evaluate(
    frames: Iterable[KittiFrame | tuple[Labels, Detections, Calibration | None]],
    classes: Sequence[str] | None = None,
    *,
    min_overlap: Mapping[str, float] | None = None,
    no_difficulty: bool = False,
    python_port: bool = False,
) -> KittiResult:
    """Score detections in memory.

    Args:
        frames: one entry per frame; without a calibration only ``no_difficulty`` is possible.
        classes: to score; None takes the classes of the detector.
        min_overlap: IoU thresholds other than ``DEFAULT_OVERLAP``, by class.
        no_difficulty: score every object, one AP per class, in BEV and in 3-D; for data without a camera.
        python_port: ignore a label box of exactly the minimum height, as the widespread Python port does.

    Raises:
        BeamboxError: if there is no frame, a class has no threshold, or labels cannot tell their difficulty.
    """
    pairs, known = [], {}
    for number, entry in enumerate(frames):
        frame = entry if isinstance(entry, KittiFrame) else KittiFrame(*entry)
        known.update(dict.fromkeys(frame.detections.classes))
        calibration = None if no_difficulty else frame.calibration
        gt = objects_from_labels(frame.labels, calibration)
        det = objects_from_detections(frame.detections, calibration, frame.image_size)
        if not no_difficulty and not (gt.has_camera and det.has_camera):
            lacks = "image attributes" if frame.calibration is not None else "camera calibration"
            raise BeamboxError(
                f"frame {frame.detections.frame_id or number} has no {lacks}, without which KITTI's difficulty levels "
                "cannot be told; give label files with a camera or score with no_difficulty=True"
            )
        pairs.append((gt, det))
    return _evaluate(pairs, classes or tuple(known) or CLASSES, min_overlap, no_difficulty, python_port)


def evaluate_files(
    labels: Path,
    results: Path,
    frames: Sequence[str] | None = None,
    classes: Sequence[str] = CLASSES,
    *,
    min_overlap: Mapping[str, float] | None = None,
    no_difficulty: bool = False,
    python_port: bool = False,
    allow_missing: bool = False,
) -> KittiResult:
    """Score result files against label files; needs no calibration.

    Args:
        labels: folder of label files, or a KITTI root.
        results: folder of result files, one per frame; an empty file says that nothing was found.
        frames: names of the frames; None takes every label file.
        classes: to score.
        min_overlap: as for :func:`evaluate`.
        no_difficulty: as for :func:`evaluate`.
        python_port: as for :func:`evaluate`.
        allow_missing: score a frame without a result file as if nothing had been found.

    Raises:
        BeamboxError: if a file is missing or broken.
    """
    pairs = read_pairs(labels, results, frames, allow_missing)
    return _evaluate(pairs, classes, min_overlap, no_difficulty, python_port)


def score_thresholds(scores: Floats, objects: int) -> Floats:
    """Choose at most 41 score thresholds, about 1/40 of recall apart.

    Args:
        scores: of the true positives of the first pass, descending.
        objects: number of ground-truth boxes that count.
    """
    chosen, recall = [], 0.0
    last = len(scores) - 1
    for i, score in enumerate(scores):
        left = (i + 1) / objects
        right = (i + 2) / objects if i < last else left
        if right - recall < recall - left and i < last:
            continue
        chosen.append(score)
        recall += 1 / (SAMPLES - 1)
    return np.array(chosen[:SAMPLES])


class _Rows(NamedTuple):
    """Columns of all frames in one row, and the overlaps of each frame."""

    gt_name: NDArray[np.str_]
    det_name: NDArray[np.str_]
    gt_height: Floats
    det_height: Floats
    occlusion: Floats
    truncation: Floats
    score: Floats
    gt_alpha: Floats
    det_alpha: Floats
    dontcare_overlap: Floats
    gt_start: NDArray[np.int64]
    det_start: NDArray[np.int64]
    pair_start: NDArray[np.int64]
    image: Floats
    bev: Floats
    box3d: Floats


def _rows(pairs: Sequence[tuple[Objects, Objects]]) -> _Rows:
    def join(parts: Iterable[Floats]) -> Floats:
        return np.concatenate([np.zeros(0), *(part.reshape(-1) for part in parts)])

    gts, dets = [gt for gt, _ in pairs], [det for _, det in pairs]
    rotated = [rotated_overlaps(gt.box, det.box) for gt, det in pairs]
    sizes = [(len(gt), len(det)) for gt, det in pairs]
    gt_image = np.concatenate([gt.image for gt in gts])
    det_image = np.concatenate([det.image for det in dets])
    return _Rows(
        gt_name=np.array([name for gt in gts for name in gt.names], dtype=np.str_),
        det_name=np.array([name for det in dets for name in det.names], dtype=np.str_),
        gt_height=gt_image[:, 3] - gt_image[:, 1],
        det_height=np.trunc(np.abs(det_image[:, 3] - det_image[:, 1])),  # the devkit keeps it as an integer
        occlusion=join(gt.occlusion for gt in gts),
        truncation=join(gt.truncation for gt in gts),
        score=join(det.score for det in dets),
        gt_alpha=join(gt.alpha for gt in gts),
        det_alpha=join(det.alpha for det in dets),
        dontcare_overlap=join(covered_share(det.image, gt.ignored_image) for gt, det in pairs),
        gt_start=starts([t for t, _ in sizes]),
        det_start=starts([d for _, d in sizes]),
        pair_start=starts([t * d for t, d in sizes]),
        image=join(image_overlap(gt.image, det.image) for gt, det in pairs),
        bev=join(bev for bev, _ in rotated),
        box3d=join(box for _, box in rotated),
    )


def _evaluate(
    pairs: Sequence[tuple[Objects, Objects]],
    classes: Sequence[str],
    min_overlap: Mapping[str, float] | None,
    no_difficulty: bool,
    python_port: bool,
) -> KittiResult:
    if not pairs:
        raise BeamboxError("there is nothing to score: no frame was given")
    overlaps = _overlaps_of(classes, min_overlap or {})
    rows = _rows(pairs)
    levels = EVERYBODY if no_difficulty else LEVELS
    oriented = not bool((rows.det_alpha == -10).any())
    results = tuple(
        _evaluate_class(rows, name, overlap, levels, python_port, not no_difficulty, oriented)
        for name, overlap in overlaps.items()
    )
    return KittiResult(results, tuple(level.name for level in levels), len(pairs), python_port)


def _overlaps_of(classes: Sequence[str], min_overlap: Mapping[str, float]) -> dict[str, float]:
    given = {name.lower(): value for name, value in min_overlap.items()}
    wanted = [name.lower() for name in classes]
    for name, value in given.items():
        if name not in wanted:
            raise BeamboxError(
                f"an IoU threshold was given for {name!r}, which is not scored{did_you_mean(name, wanted)}"
            )
        if not 0 < value < 1:
            raise BeamboxError(f"the IoU threshold of {name!r} must lie between 0 and 1, got {value:g}")
    known = {**DEFAULT_OVERLAP, **given}
    for name in classes:
        if name.lower() not in known:
            raise BeamboxError(f"no IoU threshold is known for class {name!r}; give one, for example {name}=0.5")
    return {name: known[name.lower()] for name in classes}


def _evaluate_class(
    rows: _Rows,
    name: str,
    min_overlap: float,
    levels: Sequence[Difficulty],
    python_port: bool,
    camera: bool,
    oriented: bool,
) -> ClassResult:
    box3d, bev, image, orientation = [], [], [], []
    objects = []
    nothing_spared = np.zeros(len(rows.score), dtype=np.bool_)
    for level in levels:
        flags = _flags(rows, name.lower(), level, python_port)
        objects.append(int((flags[0] == 0).sum()))
        for into, overlap in ((box3d, rows.box3d), (bev, rows.bev)):
            into.append(_average(_table(rows, flags, overlap, min_overlap, nothing_spared), False)[0])
        if camera:
            spared = rows.dontcare_overlap > min_overlap
            flat, turned = _average(_table(rows, flags, rows.image, min_overlap, spared), oriented)
            image.append(flat)
            orientation.append(turned)
    labeled = int((rows.gt_name == name.lower()).sum())
    averages = (tuple(box3d), tuple(bev), tuple(image), tuple(orientation))  # the last two empty without a camera
    return ClassResult(name, min_overlap, tuple(objects), *averages, labeled)


def _flags(rows: _Rows, name: str, level: Difficulty, python_port: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    low = rows.gt_height <= level.min_height if python_port else rows.gt_height < level.min_height
    unseen = low | (rows.occlusion > level.max_occlusion) | (rows.truncation > level.max_truncation)
    gt = np.full(len(rows.gt_name), -1)
    gt[rows.gt_name == NEIGHBOR.get(name, "")] = 1
    valid = rows.gt_name == name
    gt[valid] = np.where(unseen[valid], 1, 0)
    det = np.where(rows.det_name == name, 0, -1)
    det[rows.det_height < level.min_height] = 1  # whatever its class
    return gt, det


def _table(
    rows: _Rows,
    flags: tuple[NDArray[np.int64], NDArray[np.int64]],
    overlap: Floats,
    min_overlap: float,
    dontcare: NDArray[np.bool_],
) -> MatchTable:
    return MatchTable(
        rows.gt_start,
        rows.det_start,
        rows.pair_start,
        overlap,
        min_overlap,
        flags[0],
        flags[1],
        rows.score,
        dontcare,
        rows.gt_alpha,
        rows.det_alpha,
    )


def _average(table: MatchTable, oriented: bool) -> tuple[AveragePrecision, AveragePrecision]:
    """Return the AP of a table and its AP with orientation (not known where it is not scored)."""
    if table.objects == 0:
        return AveragePrecision.unknown(), AveragePrecision.unknown()
    thresholds = score_thresholds(true_positive_scores(table), table.objects)
    counts = count(table)
    plain = _average_curve(counts, counts.precision(), thresholds)
    if not oriented:
        return plain, AveragePrecision.unknown()
    return plain, _average_curve(counts, counts.oriented_precision(), thresholds)


def _average_curve(counts: Counts, curve: Floats, thresholds: Floats) -> AveragePrecision:
    sampled = sampled_precision(counts, curve, thresholds, SAMPLES)
    return AveragePrecision(
        r40=float(100 * sampled[1:].sum() / 40),
        r11=float(100 * sampled[::4].sum() / 11),
        all_points=all_point_ap(counts, curve),
        curve=tuple(sampled.tolist()),
    )
