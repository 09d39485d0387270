"""Score a drive's tracks against KITTI's tracking labels, by overlaps in 3-D, from above or in the image.

Who takes part follows KITTI's tracking benchmark (its devkit; TrackEval): objects of a neighbouring class, truncated
ones and such of unknown occlusion are neither right nor wrong, and so are tracks without a partner that lie in a
DontCare region or are at most 25 pixels tall.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.kitti_text import read_calibration
from beambox.data.kitti_tracking import TrackedObjects, read_tracking
from beambox.metrics.overlap import covered_share, image_overlap, rotated_overlaps
from beambox.metrics.tracking import ClearScores, HotaScores, TrackingFrame, amota, assign, clear_mot, hota

__all__ = ["Drive", "TrackingResult", "read_drives", "score_tracks"]

Floats = NDArray[np.float64]
Overlap = Literal["3d", "bev", "2d"]
OVERLAPS = ("3d", "bev", "2d")
NEIGHBORS = {"Car": ("Van",), "Pedestrian": ("Person_sitting", "Person")}
MIN_OVERLAP = {"Car": 0.5, "Pedestrian": 0.25, "Cyclist": 0.25}
IMAGE_OVERLAP = 0.5
MIN_HEIGHT = 25.0
MOST_OCCLUDED, MOST_TRUNCATED = 2, 0
IN_DONT_CARE = 0.5

Drive = tuple[Mapping[int, TrackedObjects], Mapping[int, TrackedObjects]]
"""Labels and tracks of one drive: frame number -> objects."""


@dataclass(frozen=True)
class ClassScores:
    """Scores of one class."""

    hota: HotaScores
    clear: ClearScores
    amota: float
    samota: float
    min_overlap: float


@dataclass(frozen=True)
class TrackingResult:
    """Scores of all classes."""

    classes: Mapping[str, ClassScores]
    overlap: Overlap

    def table(self) -> str:
        """Return a table; shares in percent."""
        head = ("class", "IoU", "HOTA", "DetA", "AssA", "MOTA", "MOTP", "AMOTA", "sAMOTA")
        counts = ("switches", "fragments", "TP", "FP", "FN", "MT", "ML", "objects")
        lines = [f"tracks, overlap {self.overlap}", " ".join(f"{word:>9}" for word in (*head, *counts))]
        for name, one in self.classes.items():
            shares = (one.hota.hota, one.hota.det_a, one.hota.ass_a, one.clear.mota, one.clear.motp)
            shares = (*shares, one.amota, one.samota)
            cells = [name, f"{one.min_overlap:g}", *(f"{100 * share:.2f}" for share in shares)]
            clear = one.clear
            cells += [str(n) for n in (clear.switches, clear.fragments, clear.tp, clear.fp, clear.fn)]
            cells += [str(n) for n in (clear.mostly_tracked, clear.mostly_lost, clear.objects)]
            lines.append(" ".join(f"{word:>9}" for word in cells))
        return "\n".join(lines) + "\n"

    def to_json(self) -> dict[str, Any]:
        """Return numbers for other programs; shares in percent, None where there is nothing to score."""

        def percent(share: float) -> float | None:
            return None if math.isnan(share) else 100 * share

        return {
            name: {
                "iou": one.min_overlap,
                "overlap": self.overlap,
                "hota": percent(one.hota.hota),
                "deta": percent(one.hota.det_a),
                "assa": percent(one.hota.ass_a),
                "loca": percent(one.hota.loc_a),
                "mota": percent(one.clear.mota),
                "motp": percent(one.clear.motp),
                "amota": percent(one.amota),
                "samota": percent(one.samota),
                **{
                    key: getattr(one.clear, key)
                    for key in ("tp", "fp", "fn", "switches", "fragments", "mostly_tracked", "mostly_lost", "objects")
                },
            }
            for name, one in self.classes.items()
        }


def score_tracks(
    drives: Sequence[Drive],
    classes: Sequence[str] = ("Car", "Pedestrian", "Cyclist"),
    *,
    overlap: Overlap = "3d",
    min_overlap: Mapping[str, float] | None = None,
) -> TrackingResult:
    """Score tracks.

    Args:
        drives: labels and tracks of each drive; identities are unique within one.
        classes: to score.
        overlap: "3d" (volumes), "bev" (from above) or "2d" (image boxes, as KITTI's benchmark).
        min_overlap: from which overlap a pair matches, for MOTA and AMOTA; by class. 0.5 for cars and 0.25 for others
            where not given, 0.5 for all in the image.

    Raises:
        BeamboxError: for an unknown overlap, or tracks without a score.
    """
    if overlap not in OVERLAPS:
        raise BeamboxError(f'unknown overlap "{overlap}"{did_you_mean(overlap, OVERLAPS)}')
    given = dict(min_overlap or {})
    for name in given:
        if name not in classes:
            raise BeamboxError(f'an overlap is given for "{name}", which is not scored{did_you_mean(name, classes)}')
    scored = {}
    for name in classes:
        usual = IMAGE_OVERLAP if overlap == "2d" else MIN_OVERLAP.get(name, 0.25)
        least = given.get(name, usual)
        frames: list[TrackingFrame] = []
        gt_offset = offset = 0
        for labels, tracks in drives:
            part = [
                _frame(labels.get(k, NOTHING), tracks.get(k, NOTHING), name, overlap, least)
                for k in sorted({*labels, *tracks})
            ]
            frames += [TrackingFrame(one.gt_ids + gt_offset, one.ids + offset, one.overlap, one.scores) for one in part]
            gt_offset = 1 + max((int(one.gt_ids.max()) for one in frames if len(one.gt_ids)), default=gt_offset)
            offset = 1 + max((int(one.ids.max()) for one in frames if len(one.ids)), default=offset)
        clear = clear_mot(frames, least)
        scored[name] = ClassScores(hota(frames), clear, *amota(frames, least), least)
    return TrackingResult(scored, overlap)


def read_drives(labels: Path, results: Path, calib: Path) -> list[Drive]:
    """Read labels and tracks in KITTI's format: three files of one drive, or folders of files of the same names.

    Raises:
        MissingFileError: if a drive that is labelled has no tracks or no calibration.
        BeamboxError: naming file and line, if one cannot be parsed.
    """
    names = sorted(path.name for path in labels.glob("*.txt")) if labels.is_dir() else [""]
    if not names:
        raise MissingFileError(f"{labels} holds no label file (*.txt)")
    drives = []
    for name in names:
        calibration = read_calibration(calib / name if calib.is_dir() else calib)
        truth = read_tracking(labels / name if name else labels, calibration)
        drives.append((truth, read_tracking(results / name if name else results, calibration)))
    return drives


NOTHING = TrackedObjects(
    ids=np.zeros(0, dtype=np.int64),
    names=(),
    boxes=np.zeros((0, 7)),
    image=np.zeros((0, 4)),
    truncation=np.zeros(0),
    occlusion=np.zeros(0, dtype=np.int64),
    scores=np.zeros(0),
    ignored=np.zeros((0, 4)),
)


def _overlaps(labels: TrackedObjects, tracks: TrackedObjects, overlap: Overlap) -> Floats:
    if overlap == "2d":
        return image_overlap(labels.image, tracks.image)
    bev, volume = rotated_overlaps(labels.boxes, tracks.boxes)
    return bev if overlap == "bev" else volume


def _frame(labels: TrackedObjects, tracks: TrackedObjects, name: str, overlap: Overlap, least: float) -> TrackingFrame:
    """Leave out what does not take part."""
    labels = _of(labels, np.isin(labels.names, [name, *NEIGHBORS.get(name, ())]))
    tracks = _of(tracks, np.isin(tracks.names, [name]))
    pairs = _overlaps(labels, tracks, overlap)
    spared = np.array([one != name for one in labels.names], dtype=bool)
    spared |= (labels.occlusion > MOST_OCCLUDED) | (labels.truncation > MOST_TRUNCATED)
    left, right = assign(np.where(pairs >= least, pairs, 0.0))
    matched = pairs[left, right] >= least
    left, right = left[matched], right[matched]
    keep = np.ones(len(tracks), dtype=bool)
    keep[right[spared[left]]] = False
    alone = np.ones(len(tracks), dtype=bool)
    alone[right] = False
    small = tracks.image[:, 3] - tracks.image[:, 1] <= MIN_HEIGHT
    keep &= ~(alone & (small | (covered_share(tracks.image, labels.ignored) > IN_DONT_CARE)))
    scores = np.where(np.isnan(tracks.scores), 1.0, tracks.scores)
    return TrackingFrame(labels.ids[~spared], tracks.ids[keep], pairs[~spared][:, keep], scores[keep])


def _of(objects: TrackedObjects, keep: NDArray[np.bool_]) -> TrackedObjects:
    keep = keep.reshape(-1).astype(bool)
    return TrackedObjects(
        objects.ids[keep],
        tuple(one for one, wanted in zip(objects.names, keep) if wanted),
        objects.boxes[keep],
        objects.image[keep],
        objects.truncation[keep],
        objects.occlusion[keep],
        objects.scores[keep],
        objects.ignored,
    )
