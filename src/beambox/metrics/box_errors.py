"""Errors of the boxes that were found: where they stand, how large they are and where they point.

AP asks how many boxes are right; this asks in which way the found ones are wrong. Two matchings, both greedy:
detections of a class, best first, each take the best free object of the frame.

* **Signed errors** (detected minus labelled) over pairs whose BEV boxes overlap by an IoU above 0.25, so that a wrong
  height does not decide what is compared.
* **ATE, ASE, AOE** by nuScenes' rule: the nearest object whose centre is less than 2 m away over the ground; means over
  recalls from 0.1 to the largest reached (H. Caesar et al., "nuScenes", CVPR 2020, section 3.1).

Objects beyond KITTI's hard level, where labels tell it, are ignored: they take their detection away from the others,
and nothing is counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError
from beambox.metrics.box_errors_result import BANDS, COLUMNS, Band, BoxErrors, ClassErrors
from beambox.metrics.kitti import KittiFrame
from beambox.metrics.overlap import rotated_overlaps
from beambox.structures.labels import Labels

__all__ = ["MIN_OVERLAP", "NEAR", "box_errors", "countable", "greedy_pairs", "signed_errors"]

Floats = NDArray[np.float64]

MIN_OVERLAP = 0.25
"""BEV IoU that makes a pair for the signed errors."""
NEAR = 2.0
"""Distance of two centres over the ground below which nuScenes takes a pair for its true-positive errors, metres."""
RECALLS = np.linspace(0.0, 1.0, 101)
MIN_RECALL = 0.1


class _Class(NamedTuple):
    """Boxes of one class in one frame."""

    gt: Floats  # (N, 7)
    counts: NDArray[np.bool_]  # (N,) false: ignored
    det: Floats  # (M, 7), best first
    score: Floats  # (M,) descending


def box_errors(frames: Iterable[KittiFrame], classes: Sequence[str]) -> BoxErrors:
    """Measure the errors of the boxes found.

    Args:
        frames: labels and detections, both in the sensor's frame.
        classes: to look at; names are compared without regard to case.

    Raises:
        BeamboxError: if there is no frame.
    """
    frames = list(frames)
    if not frames:
        raise BeamboxError("there is nothing to score: no frame was given")
    return BoxErrors(tuple(_errors_of_class(name, [_of_class(frame, name) for frame in frames]) for name in classes))


def greedy_pairs(quality: Floats, least: float) -> list[tuple[int, int]]:
    """Let columns, in order, each take the free row of largest quality; (row, column) of those above ``least``.

    Args:
        quality: ``(N, M)`` objects by detections, detections best first.
        least: a pair's quality is greater than this.
    """
    pairs, free = [], np.ones(len(quality), dtype=np.bool_)
    for column in np.flatnonzero((quality > least).any(axis=0)):
        fitting = np.where(free, quality[:, column], -np.inf)
        row = int(fitting.argmax())
        if fitting[row] > least:
            free[row] = False
            pairs.append((row, int(column)))
    return pairs


def signed_errors(gt: Floats, det: Floats) -> Floats:
    """Return detected minus labelled, ``(N, 10)``, in the order of ``COLUMNS``; metres and radians.

    Args:
        gt: ``(N, 7)`` labelled boxes.
        det: ``(N, 7)`` the detection of each.
    """
    away = det - gt
    x, y = away[:, 0], away[:, 1]
    cos, sin = np.cos(gt[:, 6]), np.sin(gt[:, 6])
    ray = np.arctan2(gt[:, 1], gt[:, 0])
    turn = (away[:, 6] + math.pi / 2) % math.pi - math.pi / 2  # boxes look the same after half a turn
    columns = (x, y, away[:, 2], x * np.cos(ray) + y * np.sin(ray), x * cos + y * sin, y * cos - x * sin)
    return np.column_stack((*columns, away[:, 3:6], turn))


def countable(labels: Labels) -> NDArray[np.bool_]:
    """Say which objects KITTI's hard level takes in; all where labels have no image boxes."""
    if labels.attributes is None:
        return np.ones(len(labels), dtype=np.bool_)
    imageless = (labels.attributes.image == 0).all(dim=1)  # labelled without a camera
    return ((labels.attributes.difficulty() >= 0) | imageless).numpy()


def _of_class(frame: KittiFrame, name: str) -> _Class:
    labels, det = frame.labels, frame.detections
    mine = np.array([each.lower() == name.lower() for each in labels.names], dtype=np.bool_)
    theirs = torch.tensor([each.lower() == name.lower() for each in det.names], dtype=torch.bool)
    boxes, scores = det.boxes.detach().cpu()[theirs].double(), det.scores.detach().cpu()[theirs].double()
    order = torch.argsort(scores, descending=True, stable=True)
    return _Class(
        labels.boxes.double().numpy()[mine], countable(labels)[mine], boxes[order].numpy(), scores[order].numpy()
    )


def _errors_of_class(name: str, frames: Sequence[_Class]) -> ClassErrors:
    errors, distances, all_distances, flips = [np.zeros((0, len(COLUMNS)))], [np.zeros(0)], [np.zeros(0)], 0
    for gt, counts, det, _ in frames:
        all_distances.append(np.hypot(gt[counts, 0], gt[counts, 1]))
        pairs = greedy_pairs(rotated_overlaps(gt, det)[0], MIN_OVERLAP)
        kept = [pair for pair in pairs if counts[pair[0]]]
        ours, theirs = gt[[row for row, _ in kept]], det[[column for _, column in kept]]
        errors.append(signed_errors(ours, theirs))
        distances.append(np.hypot(ours[:, 0], ours[:, 1]))
        flips += int((np.cos(theirs[:, 6] - ours[:, 6]) < 0).sum())
    table, distance, everything = np.concatenate(errors), np.concatenate(distances), np.concatenate(all_distances)
    bands = []
    for label, low, high in BANDS:
        inside = table[(distance >= low) & (distance < high)]
        objects = int(((everything >= low) & (everything < high)).sum())
        bands.append(Band(label, objects, len(inside), _each(inside, np.mean), _each(inside, np.std)))
    flipped = 100 * flips / len(table) if len(table) else math.nan
    return ClassErrors(name, tuple(bands), flipped, *_nuscenes(frames))


def _each(table: Floats, what: Callable[[Floats], Any]) -> dict[str, float]:
    return {name: float(what(table[:, i])) if len(table) else math.nan for i, name in enumerate(COLUMNS)}


def _nuscenes(frames: Sequence[_Class]) -> tuple[float, float, float]:
    """Return ATE, ASE and AOE: metres, 1 - IoU, radians; as the devkit has it, 1 below a recall of 0.1."""
    scores, rows, objects = [], [], 0
    for gt, counts, det, score in frames:
        objects += int(counts.sum())
        apart = np.hypot(gt[:, None, 0] - det[None, :, 0], gt[:, None, 1] - det[None, :, 1])  # (N, M)
        partner = {column: row for row, column in greedy_pairs(-apart, -NEAR)}
        for column in range(len(det)):
            row = partner.get(column)
            if row is not None and not counts[row]:
                continue
            scores.append(score[column])
            rows.append((math.nan,) * 3 if row is None else _distances(gt[row], det[column]))
    if not objects:
        return math.nan, math.nan, math.nan
    order = np.argsort(-np.array(scores), kind="stable")
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)[order]  # (D, 3) best first, NaN: false positive
    score = np.array(scores)[order]
    right = ~np.isnan(table[:, 0])
    if not right.any():
        return 1.0, 1.0, 1.0
    recall = np.cumsum(right) / objects
    confidence = np.interp(RECALLS, recall, score, right=0.0)  # of each recall
    reached = np.flatnonzero(confidence)
    first, last = round(100 * MIN_RECALL) + 1, reached[-1] if len(reached) else 0
    if last < first:
        return 1.0, 1.0, 1.0
    running = np.cumsum(table[right], axis=0) / np.arange(1, right.sum() + 1)[:, None]
    hit_scores = score[right][::-1]
    ate, ase, aoe = (
        float(np.interp(confidence[::-1], hit_scores, running[::-1, i])[::-1][first : last + 1].mean())
        for i in range(3)
    )
    return ate, ase, aoe


def _distances(gt: Floats, det: Floats) -> tuple[float, float, float]:
    """Return the translation over the ground, 1 - IoU of the sizes alone, and the turn between the headings."""
    shared = np.minimum(gt[3:6], det[3:6]).prod()
    both = gt[3:6].prod() + det[3:6].prod() - shared
    turn = abs((det[6] - gt[6] + math.pi) % (2 * math.pi) - math.pi)
    return math.hypot(*(det[:2] - gt[:2])), 1 - float(shared / both) if both > 0 else 1.0, float(turn)
