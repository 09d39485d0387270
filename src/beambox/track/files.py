"""Tracks on disk: JSON lines, CSV, or the text of KITTI's tracking benchmark; one file per drive."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from beambox import __version__
from beambox.checks import BeamboxError
from beambox.data.kitti_tracking import format_tracking
from beambox.geometry import Calibration
from beambox.io import replacing
from beambox.track.tracks import Tracks

__all__ = ["COLUMNS", "ENDINGS", "track_file"]

ENDINGS = (".jsonl", ".csv", ".txt")
COLUMNS = ("frame", "time", "id", "name", "score", *"xyzlwh", "yaw", "vx", "vy", "vz", "age", "missed")
"""Columns of the CSV file, and keys of the objects in JSON."""

Write = Callable[[Tracks, int], None]


@contextmanager
def track_file(
    path: Path,
    model: str,
    calibration: Callable[[str], Calibration] | None = None,
    image_size: tuple[int, int] | None = None,
) -> Iterator[Write]:
    """Open a file of tracks for writing; its ending says which format. It appears once it is complete.

    Args:
        path: .jsonl (one line per sweep), .csv (one row per object) or .txt (KITTI's tracking benchmark).
        model: who found the boxes, kept in JSON.
        calibration: of a sweep by its name, for KITTI's format.
        image_size: (width, height) to which KITTI's image boxes are clipped.

    Yields:
        A function that takes the tracks of a sweep and its number in the drive.

    Raises:
        BeamboxError: for another ending, or KITTI's format without a calibration.
    """
    kind = check_ending(path)
    if kind == ".txt" and calibration is None:
        raise BeamboxError(
            f"{path}: KITTI's format holds boxes in the camera's frame, which needs a calibration; write .csv or .jsonl"
        )
    with replacing(path) as stream:
        if kind == ".csv":
            stream.write((",".join(COLUMNS) + "\n").encode())

        def write(tracks: Tracks, number: int) -> None:
            if kind == ".txt":
                assert calibration is not None
                found = tracks.detections
                text = format_tracking(
                    number,
                    tracks.ids.tolist(),
                    tracks.names,
                    found.boxes,
                    found.scores.tolist(),
                    calibration(found.frame_id),
                    image_size,
                )
            else:
                text = _csv(tracks) if kind == ".csv" else _json(tracks, model)
            stream.write(text.encode("utf-8", "backslashreplace"))

        yield write


def check_ending(path: Path) -> str:
    """Return the ending of a file of tracks.

    Raises:
        BeamboxError: if no format has it.
    """
    kind = path.suffix.lower()
    if kind not in ENDINGS:
        raise BeamboxError(
            f'{path}: tracks are written as {", ".join(ENDINGS)} (KITTI), got the ending "{path.suffix}"'
        )
    return kind


def _rows(tracks: Tracks) -> list[dict[str, float | int | str]]:
    return [
        {key: round(value, 4) if isinstance(value, float) else value for key, value in row.items()}
        for row in tracks.to_rows()
    ]


def _csv(tracks: Tracks) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([row[key] for key in COLUMNS] for row in _rows(tracks))
    return text.getvalue()


def _json(tracks: Tracks, model: str) -> str:
    objects = [{key: row[key] for key in COLUMNS[2:]} for row in _rows(tracks)]
    head = {"frame": tracks.detections.frame_id, "time": tracks.time, "model": model, "beambox": __version__}
    return json.dumps({**head, "tracks": objects}, allow_nan=False) + "\n"
