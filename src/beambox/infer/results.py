"""Detections on disk: KITTI text, JSON and CSV, one file per sweep; and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.kitti import read_results
from beambox.io import read_text, write_text
from beambox.structures import Detections, Frame

__all__ = ["FORMATS", "choose_formats", "find_result", "read_result", "write_results"]

FORMATS = {"json": ".json", "csv": ".csv", "kitti": ".txt"}
"""Name of each format and the ending of its files."""


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
            text = detections.to_json(model) if kind == "json" else detections.to_csv()
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
            return Detections.from_csv(text, path.name, frame.id)
        return replace(Detections.from_json(text, path.name), frame_id=frame.id)
    except BeamboxError as error:
        raise BeamboxError(f"{path} must hold detections as `beambox detect` writes them; {error}") from None
