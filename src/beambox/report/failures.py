"""The worst of an evaluation, as pictures: sure detections of nothing, missed objects, misplaced boxes."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw

from beambox.data.source import FrameSource
from beambox.report import numbers
from beambox.report.matching import Matches
from beambox.report.measure import Measured
from beambox.structures import Detections, Frame, Labels
from beambox.visualize.bev import PANEL_WIDTH, Region, draw_bev
from beambox.visualize.image import draw_camera, open_image

__all__ = ["HEADINGS", "Failure", "Picture", "draw_failures", "worst"]

HEADINGS = {
    "background": "False positives: nothing is labelled there",
    "missed": "Misses: labelled, and not found",
    "misplaced": "Misplaced: about an object, but overlapping too little",
    "wrong class": "Wrong class",
}
"""Kinds of failures and what a page calls them."""
REACH = 14.0
"""Metres around the box that a picture shows."""
CAMERA_MARGIN = 90
"""Pixels around the box in the camera image."""


@dataclass(frozen=True)
class Failure:
    """One thing that went wrong."""

    kind: str
    """One of ``HEADINGS``."""
    name: str
    """Class detected, or labelled where it was missed."""
    frame: int
    """Position of the frame."""
    row: int
    """Position among the frame's detections, or among its labels where it was missed."""
    text: str
    """What is known of it, in a line."""


@dataclass(frozen=True)
class Picture:
    """A failure, drawn."""

    failure: Failure
    frame_id: str
    bev: bytes
    """JPEG, from above; x forward is up."""
    camera: bytes | None
    """JPEG, the same place in the camera image, where there is one and it lies in it."""


def worst(matches: Matches, name: str, most: int = 6) -> list[Failure]:
    """Choose the worst failures of a class: false positives and misplaced boxes by score, misses by number of points.

    A frame appears at most twice in each kind, so that one bad frame does not fill the page.
    """
    found, truth = matches.found, matches.truth
    out: list[Failure] = []
    for kind in ("background", "misplaced", "wrong class"):
        rows = np.flatnonzero((found.name == name) & (found.kind == kind))
        for row in _spread(rows[np.argsort(-found.score[rows], kind="stable")], found.frame, most):
            words = f"score {found.score[row]:.2f}, {found.distance[row]:.0f} m"
            words += f", 3-D IoU {found.iou[row]:.2f} of {matches.thresholds[name]:.2f}" if kind == "misplaced" else ""
            words += f", labelled {found.about[row]}" if kind == "wrong class" else ""
            out.append(Failure(kind, name, int(found.frame[row]), int(found.row[row]), words))
    threshold = numbers.working_point(matches, name).score
    missed = ~(truth.score >= threshold)  # true for NaN on either side
    rows = np.flatnonzero((truth.name == name) & truth.counts & missed)
    order = np.lexsort((truth.distance[rows], -truth.points[rows]))
    for row in _spread(rows[order], truth.frame, most):
        words = f"{truth.points[row]} points, " if truth.points[row] >= 0 else ""
        words += f"{truth.distance[row]:.0f} m"
        words += f", occlusion {truth.occlusion[row]}" if truth.occlusion[row] >= 0 else ""
        low = truth.score[row]
        words += "" if np.isnan(low) else f"; found with score {low:.2f}, below the working point {threshold:.2f}"
        out.append(Failure("missed", name, int(truth.frame[row]), int(truth.row[row]), words))
    return out


def _spread(rows: np.ndarray, frame_of: np.ndarray, most: int) -> list[int]:
    seen: dict[int, int] = {}
    kept: list[int] = []
    for row in rows.tolist():
        seen[int(frame_of[row])] = seen.get(int(frame_of[row]), 0) + 1
        if seen[int(frame_of[row])] <= 2:
            kept.append(row)
        if len(kept) == most:
            break
    return kept


def draw_failures(one: Measured, source: FrameSource, failures: Sequence[Failure]) -> Iterator[Picture]:
    """Draw failures; each frame is read once, whatever the order.

    Args:
        one: the evaluation; its frames are the source's, in order.
        source: to read the points again from.
        failures: from :func:`worst`.
    """
    by_frame: dict[int, list[Failure]] = {}
    for failure in failures:
        by_frame.setdefault(failure.frame, []).append(failure)
    drawn: Mapping[int, Picture] = {}
    for number, some in by_frame.items():
        frame, kept = source[number], one.frames[number]
        for failure in some:
            drawn = {**drawn, id(failure): _draw(failure, frame, kept.labels, kept.detections)}
    for failure in failures:
        yield drawn[id(failure)]


def _draw(failure: Failure, frame: Frame, labels: Labels, detections: Detections) -> Picture:
    boxes = labels.boxes if failure.kind == "missed" else detections.boxes.cpu()
    box = boxes[failure.row]
    x, y = float(box[0]), float(box[1])
    region = Region(x - REACH, y - REACH, x + REACH, y + REACH)
    shown = detections
    if failure.kind != "missed":  # weak boxes elsewhere hide what is meant; the failure itself always stays
        keep = detections.scores.cpu() >= min(0.3, float(detections.scores[failure.row]))
        shown = detections[keep]
    bev = draw_bev(frame, shown, labels, region=region, longest=420)
    bev = bev.crop((0, 0, bev.width - PANEL_WIDTH, 420))
    around = 420 * (math.hypot(float(box[3]), float(box[4])) / 2 + 0.8) / (2 * REACH)  # pixels
    middle = (bev.width / 2, bev.height / 2)
    ImageDraw.Draw(bev).ellipse(
        (middle[0] - around, middle[1] - around, middle[0] + around, middle[1] + around), outline="white", width=1
    )
    camera = None
    if frame.calibration is not None and frame.image_path is not None:
        picture = draw_camera(open_image(frame.image_path), frame.calibration, shown, labels)
        camera = _around(picture, frame.calibration.to_camera(box[None]).image[0])
    return Picture(failure, frame.id, _jpeg(bev), camera)


def _around(picture: Image.Image, image_box: torch.Tensor) -> bytes | None:
    left, top, right, bottom = (float(v) for v in image_box)
    left, right = max(0.0, left - CAMERA_MARGIN), min(float(picture.width), right + CAMERA_MARGIN)
    top, bottom = max(0.0, top - CAMERA_MARGIN), min(float(picture.height), bottom + CAMERA_MARGIN)
    if right - left < 20 or bottom - top < 20:
        return None
    cut = picture.crop((round(left), round(top), round(right), round(bottom)))
    cut.thumbnail((640, 420))
    return _jpeg(cut)


def _jpeg(picture: Image.Image) -> bytes:
    stream = io.BytesIO()
    picture.convert("RGB").save(stream, format="JPEG", quality=82)
    return stream.getvalue()
