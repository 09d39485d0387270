"""ONCE's benchmark: AP with a heading gate, for each class and band of distance.

The algorithm is that of the official devkit (ONCE_Benchmark, CPU evaluation), its quirks included:

* a box of another class that lies outside the band is ignored, not left out, and may absorb a detection;
* a pair whose headings differ by more than 90 degrees does not overlap;
* boxes are turned clockwise by their headings, although headings grow counter-clockwise. Published numbers carry this;
  ``true_rotation`` turns them the right way round (on our recording that moves single APs by up to 4 points);
* a pair whose centres lie more than 5 m apart does not overlap;
* thresholds repeat where there are few objects, so small sets are not penalised (KITTI's are);
* a class without objects in a band scores 0 and counts in the mean.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.geometry.boxes import wrap_angle
from beambox.io import read_json
from beambox.metrics.matching import MatchTable, count, sampled_precision, true_positive_scores
from beambox.metrics.once_result import OnceResult
from beambox.metrics.overlap import rotated_overlaps, starts
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = [
    "FIVE_CLASSES",
    "SUPERCLASSES",
    "OnceBoxes",
    "OnceResult",
    "evaluate",
    "evaluate_annotations",
    "evaluate_boxes",
    "score_thresholds",
]

Floats = NDArray[np.float64]

SUPERCLASSES = {"Vehicle": 0.7, "Pedestrian": 0.3, "Cyclist": 0.5}
"""Classes of the default mode, with the IoU above which a detection matches."""
FIVE_CLASSES = {"Car": 0.7, "Bus": 0.7, "Truck": 0.7, "Pedestrian": 0.3, "Cyclist": 0.5}
"""Classes as the labels have them."""
SUPERCLASS_OF = {"Car": "Vehicle", "Bus": "Vehicle", "Truck": "Vehicle"}
LIMITS = ((0.0, math.inf), (0.0, 30.0), (30.0, 50.0), (50.0, math.inf))
"""Distance of each band, metres; the upper end does not belong to it."""
SAMPLES = 51
FARTHEST_PAIR = 5.0
"""Centres, in BEV, farther apart than this many metres do not overlap."""


@dataclass(frozen=True)
class OnceBoxes:
    """Boxes of one frame, ground truth or predictions; N boxes."""

    names: tuple[str, ...]
    """Class of each."""
    boxes: Floats
    """``(N, 7)`` x, y, z, l, w, h, yaw in the sensor's frame; metres, radians."""
    scores: Floats
    """``(N,)``; zeros for ground truth."""


def evaluate(
    frames: Iterable[tuple[Labels, Detections]],
    *,
    five_classes: bool = False,
    min_overlap: Mapping[str, float] | None = None,
    true_rotation: bool = False,
    known: Collection[str] | None = None,
) -> OnceResult:
    """Score detections in memory.

    Args:
        frames: ground truth and detections of every annotated frame.
        five_classes: score the labels' own classes instead of merging Car, Bus and Truck into Vehicle.
        min_overlap: other IoU thresholds, by class.
        true_rotation: turn boxes counter-clockwise; the numbers then no longer compare with published ones.
        known: the classes that a detector knows, by the labels' names; others are not scored. All by default.

    Raises:
        BeamboxError: if there is no frame, a threshold is given for a class that is not scored, or none is known.
    """
    pairs = []
    for labels, det in frames:
        gt_boxes, boxes = labels.boxes.double(), det.boxes.detach().cpu().double()
        for each in (gt_boxes, boxes):
            each[:, 6] = wrap_angle(each[:, 6])
        gt = OnceBoxes(labels.names, gt_boxes.numpy(), np.zeros(len(labels)))
        scores = det.scores.detach().cpu().double().numpy()
        pairs.append((gt, OnceBoxes(tuple(det.names), boxes.numpy(), scores)))
    return evaluate_boxes(
        pairs, five_classes=five_classes, min_overlap=min_overlap, true_rotation=true_rotation, known=known
    )


def evaluate_annotations(
    annotations: Path,
    results: Path | None = None,
    *,
    five_classes: bool = False,
    min_overlap: Mapping[str, float] | None = None,
    true_rotation: bool = False,
    known: Collection[str] | None = None,
) -> OnceResult:
    """Score a file of annotations and predictions.

    Args:
        annotations: JSON ``{"ground_truth": [...], "predictions": [...]}``, each entry
            ``{"frame_id", "names", "boxes_3d"}`` and ``"scores"`` with the predictions.
        results: JSON list of predictions, where they lie in a file of their own.
        five_classes: as for :func:`evaluate`.
        min_overlap: as for :func:`evaluate`.
        true_rotation: as for :func:`evaluate`.
        known: as for :func:`evaluate`.

    Raises:
        BeamboxError: naming the file and the key that cannot be used.
    """
    content = _read(annotations)
    gts = _entries(content, "ground_truth", annotations)
    dets = (
        _entries(content, "predictions", annotations)
        if results is None
        else _entries(_read(results), "predictions", results)
    )
    source = annotations if results is None else results
    det_by_id = {_frame_id(entry): entry for entry in dets}
    annotated = [_frame_id(entry) for entry in gts]
    for where, names in ((annotations, annotated), (source, [_frame_id(entry) for entry in dets])):
        repeated = next((name for name, count in Counter(names).items() if count > 1), None)
        if repeated is not None:
            raise BeamboxError(f"{where} must hold each frame once, but holds {repeated} again")
    missing = [name for name in annotated if name not in det_by_id]
    if missing:
        raise BeamboxError(
            f"{source}: {len(missing)} of {len(annotated)} annotated frames have no predictions, the first is "
            f"{min(missing)}; write an entry with empty lists where nothing was found"
        )
    pairs = []
    for entry in gts:
        name = _frame_id(entry)
        gt = _boxes(entry, f"{annotations}, ground truth of frame {name}", scored=False)
        pairs.append((gt, _boxes(det_by_id[name], f"{source}, predictions of frame {name}", scored=True)))
    return evaluate_boxes(
        pairs, five_classes=five_classes, min_overlap=min_overlap, true_rotation=true_rotation, known=known
    )


def evaluate_boxes(
    pairs: Sequence[tuple[OnceBoxes, OnceBoxes]],
    *,
    five_classes: bool = False,
    min_overlap: Mapping[str, float] | None = None,
    true_rotation: bool = False,
    known: Collection[str] | None = None,
) -> OnceResult:
    """Score boxes; arguments as in :func:`evaluate`, with (ground truth, predictions) of each frame."""
    if not pairs:
        raise BeamboxError("there is nothing to score: no frame was given")
    minima = _thresholds(FIVE_CLASSES if five_classes else SUPERCLASSES, min_overlap or {})
    merge = {} if five_classes else SUPERCLASS_OF
    all_classes = len(minima)
    pairs, unknown = _with_known_names(pairs)
    if known is not None:
        learned = {merge.get(name, name) for name in (_KNOWN_NAMES.get(each.lower(), each) for each in known)}
        minima = {name: minimum for name, minimum in minima.items() if name in learned}
        if not minima:
            all_names = dict.fromkeys((*SUPERCLASSES, *FIVE_CLASSES))
            raise BeamboxError(
                f"ONCE's metric scores {', '.join(all_names)}; the detector knows {', '.join(known) or 'no class'}"
            )
    gt_name = np.array([merge.get(name, name) for gt, _ in pairs for name in gt.names], dtype=np.str_)
    det_name = np.array([merge.get(name, name) for _, det in pairs for name in det.names], dtype=np.str_)
    gt_range, det_range = (
        np.concatenate([np.linalg.norm(pair[side].boxes[:, :3], axis=1) for pair in pairs]) for side in (0, 1)
    )
    overlap = np.concatenate([gated_overlap(gt.boxes, det.boxes, true_rotation).reshape(-1) for gt, det in pairs])
    sizes = [(len(gt.names), len(det.names)) for gt, det in pairs]
    scores = np.concatenate([det.scores for _, det in pairs])
    nothing = np.zeros(len(scores), dtype=np.bool_)
    values, objects = [], []
    for name, minimum in minima.items():
        tables = [
            MatchTable(
                gt_start=starts([t for t, _ in sizes]),
                det_start=starts([d for _, d in sizes]),
                pair_start=starts([t * d for t, d in sizes]),
                overlap=overlap,
                min_overlap=minimum,
                gt_flag=_flags(gt_name == name, gt_range, band),
                det_flag=_flags(det_name == name, det_range, band),
                score=scores,
                dontcare=nothing,
                gt_alpha=np.zeros(len(gt_name)),
                det_alpha=np.zeros(len(det_name)),
            )
            for band in LIMITS
        ]
        values.append(tuple(_average_precision(table) for table in tables))
        objects.append(tuple(table.objects for table in tables))
    whole = len(minima) == all_classes
    return OnceResult(tuple(minima), tuple(minima.values()), tuple(values), tuple(objects), len(pairs), whole, unknown)


_KNOWN_NAMES = {name.lower(): name for name in (*FIVE_CLASSES, *SUPERCLASSES)}
ELSEWHERE = {"bicycle": "Cyclist", "motorcycle": "Cyclist", "person": "Pedestrian", "van": "Car"}
"""Names that other data sets and toolboxes have for ONCE's classes."""


def _with_known_names(
    pairs: Sequence[tuple[OnceBoxes, OnceBoxes]],
) -> tuple[list[tuple[OnceBoxes, OnceBoxes]], tuple[str, ...]]:
    """Write names as ONCE does, whatever their case; the second value tells of names that it does not have."""
    unknown: Counter[str] = Counter(
        name for pair in pairs for side in pair for name in side.names if name.lower() not in _KNOWN_NAMES
    )
    unknown_names = []
    for name, boxes in unknown.most_common():
        meant = ELSEWHERE.get(name.lower())
        hint = f' (did you mean "{meant}"?)' if meant else did_you_mean(name, FIVE_CLASSES)
        unknown_names.append(f"{name}, {boxes} boxes{hint}")

    def named(side: OnceBoxes) -> OnceBoxes:
        return replace(side, names=tuple(_KNOWN_NAMES.get(name.lower(), name) for name in side.names))

    return [(named(gt), named(det)) for gt, det in pairs], tuple(unknown_names)


def gated_overlap(gt: Floats, det: Floats, true_rotation: bool = False) -> Floats:
    """Return the 3-D IoU as the devkit has it, 0 for far pairs and opposed headings.

    Args:
        gt: ``(N, 7)``.
        det: ``(M, 7)``.
        true_rotation: turn boxes counter-clockwise instead of clockwise.

    Returns:
        ``(N, M)``.
    """
    sense = np.array([1, 1, 1, 1, 1, 1, 1 if true_rotation else -1])
    overlap = rotated_overlaps(gt * sense, det * sense)[1]
    turn = np.abs(gt[:, None, 6] - det[None, :, 6])
    turn = np.where(turn >= math.pi, 2 * math.pi - turn, turn)
    apart = np.hypot(gt[:, None, 0] - det[None, :, 0], gt[:, None, 1] - det[None, :, 1])
    return np.where((turn > math.pi / 2) | (apart > FARTHEST_PAIR), 0.0, overlap)


def score_thresholds(scores: Floats, objects: int) -> Floats:
    """Choose at most 51 score thresholds, 1/50 of recall apart; a score repeats where one object spans several.

    Args:
        scores: of the true positives of the first pass, descending.
        objects: number of ground-truth boxes that count.
    """
    chosen, recall = [], 0.0
    last = len(scores) - 1
    for i, score in enumerate(scores):
        left = (i + 1) / objects
        right = (i + 2) / objects if i < last else left
        if right + left < 2 * recall and i < last:
            continue
        chosen.append(score)
        recall += 1 / (SAMPLES - 1)
        while right + left + 1e-6 > 2 * recall:
            chosen.append(score)
            recall += 1 / (SAMPLES - 1)
    return np.array(chosen[:SAMPLES])


def _flags(of_class: NDArray[np.bool_], distance: Floats, band: tuple[float, float]) -> NDArray[np.int64]:
    flags = np.where(of_class, 0, -1)
    flags[(distance < band[0]) | (distance >= band[1])] = 1  # whatever the class, as the devkit does
    return flags


def _average_precision(table: MatchTable) -> float:
    if table.objects == 0:
        return 0.0
    counts = count(table)
    thresholds = score_thresholds(true_positive_scores(table), table.objects)
    return float(100 * sampled_precision(counts, counts.precision(), thresholds, SAMPLES)[1:].sum() / (SAMPLES - 1))


def _thresholds(classes: Mapping[str, float], given: Mapping[str, float]) -> dict[str, float]:
    for name, value in given.items():
        if name not in classes:
            raise BeamboxError(
                f"an IoU threshold was given for {name!r}, which is not scored{did_you_mean(name, classes)}"
            )
        if not 0 < value < 1:
            raise BeamboxError(f"the IoU threshold of {name!r} must lie between 0 and 1, got {value:g}")
    return {**classes, **given}


def _read(path: Path) -> Any:
    if not path.is_file():
        raise MissingFileError(f"{path} does not exist; it holds ONCE annotations as JSON")
    return read_json(path)


def _entries(content: Any, key: str, path: Path) -> list[dict[str, Any]]:
    """Return the list of frames, which may stand alone or under a key, without those that nobody annotated."""
    if isinstance(content, dict):
        if key not in content:
            raise BeamboxError(f"{path}: the key {key!r} is missing{did_you_mean(key, content)}")
        content = content[key]
    if not isinstance(content, list) or not all(isinstance(entry, dict) and "frame_id" in entry for entry in content):
        raise BeamboxError(f"{path}: {key} must be a list of frames, each with a frame_id")
    return content


def _frame_id(entry: Mapping[str, Any]) -> str:
    return str(entry["frame_id"])[:100]


def _boxes(entry: Mapping[str, Any], where: str, scored: bool) -> OnceBoxes:
    entry = entry.get("annos", entry)
    if not isinstance(entry, dict):
        raise BeamboxError(f"{where}: expected names and boxes_3d, got {type(entry).__name__}")
    for key in ("names", "boxes_3d", *(("scores",) if scored else ())):
        if key not in entry and not (key == "scores" and "score" in entry) and not (key == "names" and "name" in entry):
            raise BeamboxError(f"{where}: the key {key!r} is missing{did_you_mean(key, entry)}")
    names = entry.get("names", entry.get("name"))
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BeamboxError(f"{where}: names must be a list of texts, got {str(names)[:60]}")
    names = tuple(names)
    try:
        boxes = np.array(entry["boxes_3d"], dtype=np.float64)
        boxes = boxes.reshape(0, 7) if boxes.size == 0 else boxes
        if boxes.ndim != 2 or boxes.shape[1] != 7:
            raise ValueError(f"got an array of shape {boxes.shape}")
        scores = np.array(entry.get("scores", entry.get("score")) if scored else [0.0] * len(names), dtype=np.float64)
        if scores.ndim != 1:
            raise ValueError(f"got scores of shape {scores.shape}")
    except (TypeError, ValueError, OverflowError) as error:
        unknown_names = str(error)[:120]
        raise BeamboxError(
            f"{where}: boxes_3d must be rows of x y z l w h yaw and scores numbers, {unknown_names}"
        ) from None
    if not len(names) == len(boxes) == len(scores):
        unknown_names = f"{len(names)} names, {len(boxes)} boxes_3d" + (f", {len(scores)} scores" if scored else "")
        raise BeamboxError(f"{where}: lists must have one length, got {unknown_names}")
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise BeamboxError(f"{where}: boxes_3d and scores must be finite numbers")
    return OnceBoxes(names, boxes, scores)
