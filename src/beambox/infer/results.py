"""Detections on disk: KITTI text, JSON and CSV, one file a sweep; and back."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import torch

from beambox import __version__
from beambox.checks import BeamboxError, did_you_mean
from beambox.data.kitti import read_results
from beambox.io import read_text, write_text
from beambox.structures import Detections, Frame

__all__ = ["FORMATS", "choose_formats", "find_result", "format_csv", "format_json", "read_result", "write_results"]

FORMATS = {"json": ".json", "csv": ".csv", "kitti": ".txt"}
"""Name of each format and the ending of its files."""
COLUMNS = ("frame", "name", "score", "x", "y", "z", "l", "w", "h", "yaw")


def choose_formats(words: str) -> list[str]:
    """Read ``"kitti,json"``.

    Raises:
        BeamboxError: for an unknown format or none.
    """
    chosen = [word.strip().lower() for word in words.split(",") if word.strip()]
    for word in chosen:
        if word not in FORMATS:
            raise BeamboxError(f'unknown format "{word}"{did_you_mean(word, FORMATS)}')
    if not chosen:
        raise BeamboxError(f"name at least one format of {', '.join(FORMATS)}")
    return list(dict.fromkeys(chosen))


def format_json(detections: Detections, model: str) -> str:
    """Write detections as JSON: who found them, and one object each; metres and radians, in the sweep's own frame."""
    rows = [{key: row[key] for key in COLUMNS[1:]} for row in _rounded(detections)]
    head = {"frame": detections.frame_id, "model": model, "beambox": __version__, "classes": list(detections.classes)}
    objects = ",\n".join("    " + json.dumps(row) for row in rows)
    return json.dumps(head, indent=2)[:-2] + ',\n  "detections": [' + (f"\n{objects}\n  " if rows else "") + "]\n}\n"


def format_csv(detections: Detections) -> str:
    """Write detections as CSV with a header line; the columns are those of the JSON's objects and the frame."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([row[key] for key in COLUMNS] for row in _rounded(detections))
    return text.getvalue()


def write_results(
    folder: Path, frame: Frame, detections: Detections, formats: Sequence[str], model: str, name: str = ""
) -> list[Path]:
    """Write one sweep's detections in several formats.

    Args:
        folder: where to; made where it is not there.
        frame: gives KITTI's format its calibration.
        detections: in the frame of the frame's points.
        formats: of :data:`FORMATS`.
        model: what to say of who found them.
        name: of the files, without ending; the frame's where empty.

    Raises:
        BeamboxError: if KITTI's format is wanted and there is no calibration.
    """
    written = []
    for kind in formats:
        if kind == "kitti":
            text = kitti_text(frame, detections)
        else:
            text = format_json(detections, model) if kind == "json" else format_csv(detections)
        path = folder / f"{name or frame.id}{FORMATS[kind]}"
        write_text(path, text)
        written.append(path)
    return written


def kitti_text(frame: Frame, detections: Detections) -> str:
    """Write detections as KITTI's result lines.

    Raises:
        BeamboxError: without a calibration: KITTI's boxes live in its camera's frame.
    """
    if frame.calibration is None:
        raise BeamboxError(
            f"{frame.id}: KITTI's result format holds boxes in the camera's frame, which needs the sweep's calibration "
            f"(looked for ../calib/{Path(frame.id).name}.txt beside a folder velodyne/); write json or csv instead"
        )
    return detections.to_kitti(frame.calibration, frame.image_size)


def find_result(folder: Path, name: str) -> Path | None:
    """Find a sweep's results in a folder, whichever format they have."""
    return next((p for ending in FORMATS.values() if (p := folder / f"{name}{ending}").exists()), None)


def read_result(path: Path, frame: Frame) -> Detections:
    """Read what :func:`write_results` wrote, or any KITTI result file.

    Raises:
        BeamboxError: if the file does not hold detections, or is KITTI's and the frame has no calibration.
    """
    if path.suffix == ".txt":
        if frame.calibration is None:
            raise BeamboxError(f"{path} holds boxes in the camera's frame; they need the calibration of {frame.id}")
        return read_results(path, frame.calibration)
    text = read_text(path)
    try:
        if path.suffix == ".csv":
            rows = list(csv.DictReader(io.StringIO(text)))
            classes = tuple(dict.fromkeys(row["name"] for row in rows))
        else:
            content = json.loads(text)
            rows, classes = content["detections"], tuple(content["classes"])
        boxes = [[float(row[key]) for key in COLUMNS[3:]] for row in rows]
        scores = [float(row["score"]) for row in rows]
        labels = [classes.index(row["name"]) for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise BeamboxError(
            f"{path} must hold detections as `beambox detect` writes them, but does not: {error}"
        ) from None
    return Detections(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 7),
        torch.tensor(scores, dtype=torch.float32),
        torch.tensor(labels, dtype=torch.int64),
        classes,
        frame.id,
    )


def _rounded(detections: Detections) -> list[dict[str, float | str]]:
    """Rows with a tenth of a millimetre and of a milliradian: what is beyond is noise."""
    return [
        {key: round(value, 4) if isinstance(value, float) else value for key, value in row.items()}
        for row in detections.to_rows()
    ]
