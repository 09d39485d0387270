"""From any label format to any other, the layouts of KITTI and ONCE included."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.box_files import (
    CAMERA_AT_THE_SENSOR,
    NamedBoxes,
    parse_box_file,
    parse_frames_file,
    parse_kitti_boxes,
)
from beambox.data.kitti_text import format_labels, read_calibration
from beambox.data.labels.catalog import FORMATS, frame_name, read_labels, write_labels
from beambox.data.labels.frames import LabeledFrame
from beambox.geometry import Calibration
from beambox.io import read_text, write_text
from beambox.structures import Labels

__all__ = ["READABLE", "WRITABLE", "convert_labels", "heading_note"]

OWN = {"kitti": ".txt", "pandaset": ".txt", "once": ".json", "csv": ".csv", "json": ".json"}
"""Formats that are read elsewhere, and the ending of their files."""
READABLE = (*FORMATS, *OWN)
WRITABLE = (*FORMATS, "kitti")


def convert_labels(
    source: Path,
    kind: str,
    out: Path,
    wanted: str,
    *,
    calib: Path | None = None,
    degrees: bool | None = None,
) -> tuple[dict[str, LabeledFrame], list[str]]:
    """Read labels and write them in another format.

    Args:
        source: a file, or a folder of files.
        kind: of :data:`READABLE`.
        out: file or folder to write.
        wanted: of :data:`WRITABLE`.
        calib: for KITTI's text: a calib file for all frames or a folder of FRAME.txt; without one boxes stand in a
            camera frame at the sensor.
        degrees: whether angles of the source are degrees; as its format has it where None.

    Returns:
        The frames as read, and notes.

    Raises:
        BeamboxError: if a format is unknown, or the source cannot be read as what it should be.
    """
    if kind not in READABLE:
        raise BeamboxError(f'unknown label format "{kind}"{did_you_mean(kind, READABLE)}')
    if wanted not in WRITABLE:
        raise BeamboxError(f'labels cannot be written as "{wanted}"{did_you_mean(wanted, WRITABLE)}')
    notes: list[str] = []
    if kind in FORMATS:
        frames, notes = read_labels(source, kind, degrees=degrees)
    else:
        frames = _read_own(source, kind, calib)
    note = heading_note(frames)
    notes += [note] if note else []
    if wanted == "kitti":
        _write_kitti(frames, out, calib)
    else:
        write_labels(frames, wanted, out)
    return frames, notes


def heading_note(frames: Mapping[str, LabeledFrame]) -> str | None:
    """Tell where most boxes are longer across than along their heading: axes or sizes are then probably swapped."""
    boxes = np.concatenate([frame.boxes for frame in frames.values()]) if frames else np.zeros((0, 7))
    large = boxes[np.maximum(boxes[:, 3], boxes[:, 4]) > 2.5]  # vehicles: nothing follows from what is nearly square
    across = int((large[:, 4] > 1.3 * large[:, 3]).sum())
    if len(large) < 3 or across * 2 <= len(large):
        return None
    return (
        f"{across} of {len(large)} boxes longer than 2.5 m are longer across than along their heading: length and "
        "width, or the axis from which the yaw counts, are probably swapped in the file"
    )


def _read_own(source: Path, kind: str, calib: Path | None) -> dict[str, LabeledFrame]:
    if not source.exists():
        raise MissingFileError(f"{source} is not there")
    if source.is_dir():
        files = {frame_name(file, source): file for file in sorted(source.rglob(f"*{OWN[kind]}"))}
        if not files:
            raise MissingFileError(f"{source} holds no label file (*{OWN[kind]})")
    else:
        files = {source.stem: source}
    found: dict[str, NamedBoxes] = {}
    for name, file in files.items():
        text = read_text(file)
        if kind == "kitti":
            found[name] = parse_kitti_boxes(text, _calibration(calib, name), str(file))
        elif kind == "once" or (not source.is_dir() and kind in ("csv", "json") and _names_frames(text)):
            found.update(parse_frames_file(text, kind, str(file)))
        else:
            found[name] = parse_box_file(text, kind, str(file))
    return {name: LabeledFrame(one.names, one.boxes, (), one.places) for name, one in found.items()}


def _names_frames(text: str) -> bool:
    return '"frame"' in text or "frame" in text.lstrip().partition("\n")[0].lower()


def _calibration(calib: Path | None, name: str) -> Calibration:
    if calib is None:
        return CAMERA_AT_THE_SENSOR
    return read_calibration(calib / f"{name}.txt" if calib.is_dir() else calib)


def _write_kitti(frames: Mapping[str, LabeledFrame], out: Path, calib: Path | None) -> None:
    from beambox.data.labels.catalog import check_part

    for name, frame in frames.items():
        labels = Labels(torch.from_numpy(frame.boxes).float(), tuple("_".join(one.split()) for one in frame.names))
        parts = [check_part(part, "kitti") for part in name.split("/")]
        write_text(out.joinpath(*parts[:-1], parts[-1] + ".txt"), format_labels(labels, _calibration(calib, name)))
