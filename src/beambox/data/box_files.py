"""Files of labelled boxes in several formats, read into names and numbers.

pandaset
    text, one box a line: ``label x y z l w h yaw [points sensor uuid]``, centres; lines that begin with # are left out.
    ``x y z l w h yaw label``, as OpenPCDet's custom data have it, is told from it by its numbers.
csv
    a header line with name, x, y, z, l, w, h, yaw in any order, and frame where one file holds all frames; further
    columns are left out. Columns are parted by commas; yaw_deg instead of yaw is in degrees.
json
    a list of objects ``{"name", "x", "y", "z", "l", "w", "h", "yaw"}`` or ``{"name", "box": [7 numbers]}``, with
    "frame" where one file holds all frames; or what ``beambox detect --format json`` writes.
once
    one file ``{"frames": [{"frame_id", "annos": {"names", "boxes_3d"}}]}``.
kitti
    label_2 text; boxes in a camera frame.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError, did_you_mean
from beambox.data import kitti_text
from beambox.data.labels.catalog import FORMATS, parse_labels
from beambox.data.labels.tables import DEGREES
from beambox.data.labels.tables import SYNONYMS as ALIASES
from beambox.file_names import word_to_name
from beambox.geometry.calibration import Calibration
from beambox.io import parse_json

__all__ = [
    "CAMERA_AT_THE_SENSOR",
    "NamedBoxes",
    "box_words",
    "parse_box_file",
    "parse_frames_file",
    "parse_kitti_boxes",
]

NUMBERS = ("x", "y", "z", "l", "w", "h", "yaw")
LONGEST_CELL = 10_000
CAMERA_AT_THE_SENSOR = Calibration(
    p2=torch.tensor([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    r0=torch.eye(3),
    velo_to_cam=torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
)
"""Camera axes (x right, y down, z forward) with the sensor as origin, for label files without a calibration."""


@dataclass(frozen=True)
class NamedBoxes:
    """Boxes as a file has them; N boxes."""

    names: tuple[str, ...]
    """Name of each as written."""
    boxes: NDArray[np.float64]
    """``(N, 7)`` x, y, z, l, w, h, yaw, in the file's axes."""
    places: tuple[str, ...]
    """Where each stands in the file, for messages."""


def parse_box_file(text: str, kind: str, where: str) -> NamedBoxes:
    """Read the boxes of one frame.

    Args:
        text: content of the file.
        kind: pandaset, csv or json, or a name of :data:`beambox.data.labels.catalog.FORMATS`.
        where: what errors call the file.

    Raises:
        BeamboxError: naming file and line or entry.
    """
    if kind in FORMATS:
        found = _tool_boxes(text, kind, where)
        return next(iter(found.values())) if found else _collect(())
    rows = {"pandaset": _pandaset_rows, "csv": _csv_rows, "json": _json_rows}[kind](text, where)
    return _collect([row[1:] for row in rows])


def parse_frames_file(text: str, kind: str, where: str) -> dict[str, NamedBoxes]:
    """Read the boxes of all frames from one file: csv, json or once. Frames without a box may be absent.

    Raises:
        BeamboxError: naming file and line or entry.
    """
    if kind in FORMATS and FORMATS[kind].write_all is not None:
        return _tool_boxes(text, kind, where)
    if kind not in ("csv", "json", "once"):
        raise BeamboxError(f"{where}: boxes in {kind} format come as one file per frame; put {{frame}} into its path")
    rows = {"csv": _csv_rows, "json": _json_rows, "once": _once_rows}[kind](text, where)
    by_frame: dict[str, list[tuple[str, Sequence[float], str]]] = {}
    for frame, name, numbers, place in rows:
        if frame is None:
            raise BeamboxError(f"{place}: one file for all frames needs the frame of each box under `frame`")
        found = by_frame.setdefault(frame, [])
        if name:
            found.append((name, numbers, place))
    return {frame: _collect(found) for frame, found in by_frame.items()}


def parse_kitti_boxes(text: str, calibration: Calibration, where: str) -> NamedBoxes:
    """Read a KITTI label file's boxes, carried into the LiDAR frame; DontCare regions are left out."""
    labels = kitti_text.parse_labels(text, calibration, where)
    return NamedBoxes(labels.names, labels.boxes.double().numpy(), (where,) * len(labels))


def _tool_boxes(text: str, kind: str, where: str) -> dict[str, NamedBoxes]:
    """Read labels of an annotation tool."""
    frames, _ = parse_labels(text, kind, where)
    return {name: NamedBoxes(frame.names, frame.boxes, frame.places) for name, frame in frames.items()}


Row = tuple[Any, str, Sequence[float], str]  # frame or None, name ("" for a frame without boxes), seven numbers, place


def _collect(rows: Iterable[tuple[str, Sequence[float], str]]) -> NamedBoxes:
    rows = list(rows)
    for _, numbers, place in rows:
        if not all(math.isfinite(value) for value in numbers) or min(numbers[3:6]) < 0:
            raise BeamboxError(f"{place}: expected finite numbers and sizes l, w, h of at least 0, got {list(numbers)}")
    boxes = np.array([numbers for _, numbers, _ in rows], dtype=np.float64).reshape(-1, 7)
    return NamedBoxes(tuple(name for name, _, _ in rows), boxes, tuple(place for _, _, place in rows))


def _floats(words: Sequence[Any], place: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except (TypeError, ValueError, OverflowError):
        shown = ", ".join(str(word)[:20] for word in words)
        raise BeamboxError(f"{place}: expected numbers x y z l w h yaw, got {shown}") from None


def _pandaset_rows(text: str, where: str) -> Iterable[Row]:
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        place = f"{where}, line {number}"
        name, numbers = box_words(words, place)
        yield None, name, _floats(numbers, place), place


def box_words(words: Sequence[str], place: str) -> tuple[str, Sequence[str]]:
    """Part the words of ``class x y z l w h yaw``, or of ``x y z l w h yaw class``, into name and seven numbers.

    Raises:
        BeamboxError: if there are fewer than eight.
    """
    if len(words) < 8:
        raise BeamboxError(f"{place}: expected `class x y z l w h yaw`, got {len(words)} columns")
    if all(map(_numeric, words[:7])) and not _numeric(words[7]):
        return word_to_name(words[7]), words[:7]
    return word_to_name(words[0]), words[1:8]


def _numeric(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _columns(known: Iterable[str], place: str) -> dict[str, str]:
    """Find the names under which a file has its columns."""
    have = {str(name).strip().lower(): name for name in known}
    degrees = next((have[name] for name in DEGREES if name in have), None)
    found = {} if degrees is None else {"degrees": degrees}
    for wanted in ("frame", "name", *NUMBERS):
        match = next((have[alias] for alias in ALIASES.get(wanted, (wanted,)) if alias in have), None)
        if match is not None:
            found[wanted] = match
        elif wanted == "yaw" and degrees is not None:
            found[wanted] = degrees
        elif wanted != "frame":
            raise BeamboxError(f"{place}: there is no column `{wanted}`{did_you_mean(wanted, map(str, have))}")
    return found


def _csv_rows(text: str, where: str) -> Iterable[Row]:
    head, _, _ = text.partition("\n")
    for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
        if head.count(mark) > head.count(","):
            raise BeamboxError(
                f"{where}, line 1: the columns are parted by {name}, expected commas (and points in numbers); say "
                "format: table, which takes them"
            )
    try:
        rows = [
            (number, [cell.strip() for cell in row])
            for number, row in enumerate(csv.reader(io.StringIO(text), skipinitialspace=True), start=1)
            if any(cell.strip() for cell in row)
        ]
    except csv.Error as error:
        raise BeamboxError(f"{where} is no table of comma-separated values: {error}") from None
    if not rows:
        raise BeamboxError(f"{where} is empty; expected a header line with name, x, y, z, l, w, h, yaw")
    header = rows[0][1]
    columns = {key: header.index(name) for key, name in _columns(header, f"{where}, line 1").items()}
    for number, row in rows[1:]:
        place = f"{where}, line {number}"
        if len(row) != len(header):
            raise BeamboxError(f"{place}: expected {len(header)} columns as in the header, got {len(row)}")
        if max(map(len, row)) > LONGEST_CELL:
            raise BeamboxError(f"{place}: a cell has {max(map(len, row))} letters")
        frame = row[columns["frame"]] if "frame" in columns else None
        yield (
            frame,
            row[columns["name"]],
            _yaw_in_radians([row[columns[key]] for key in NUMBERS], columns, place),
            place,
        )


def _yaw_in_radians(words: Sequence[Any], columns: Mapping[str, Any], place: str) -> list[float]:
    numbers = _floats(words, place)
    if columns.get("degrees") is not None and columns["degrees"] == columns["yaw"]:
        numbers[6] = math.radians(numbers[6])
    return numbers


def _json_rows(text: str, where: str) -> Iterable[Row]:
    content = parse_json(text, where)
    frame = None
    if isinstance(content, dict) and isinstance(content.get("detections"), list):
        frame, content = content.get("frame"), content["detections"]
    if not isinstance(content, list):
        raise BeamboxError(f"{where}: expected a list of boxes, got {type(content).__name__}")
    for number, given in enumerate(content):
        place = f"{where}, [{number}]"
        if not isinstance(given, Mapping):
            raise BeamboxError(f"{place}: expected an object with name, x, y, z, l, w, h, yaw")
        box = given.get("box")
        entry = {**given, **(dict(zip(NUMBERS, box)) if isinstance(box, list) and len(box) == 7 else {})}
        columns = _columns(entry, place)
        own = entry[columns["frame"]] if "frame" in columns else frame
        numbers = _yaw_in_radians([entry[columns[key]] for key in NUMBERS], columns, place)
        yield None if own is None else str(own), str(entry[columns["name"]]), numbers, place


def _once_rows(text: str, where: str) -> Iterable[Row]:
    content = parse_json(text, where)
    frames = content.get("frames") if isinstance(content, Mapping) else None
    if not isinstance(frames, list):
        raise BeamboxError(f"{where}: expected a list under the key `frames`")
    for number, frame in enumerate(frames):
        place = f"{where}, frames[{number}]"
        if not isinstance(frame, Mapping) or "frame_id" not in frame:
            raise BeamboxError(f"{place}: the key `frame_id` is missing")
        annotations = frame.get("annos")
        if annotations is None:
            continue
        names, boxes = (
            annotations.get(key) if isinstance(annotations, Mapping) else None for key in ("names", "boxes_3d")
        )
        if not isinstance(names, list) or not isinstance(boxes, list) or len(names) != len(boxes):
            raise BeamboxError(f"{place}.annos: expected lists `names` and `boxes_3d` of one length")
        yield str(frame["frame_id"]), "", (), place
        for k, (name, box) in enumerate(zip(names, boxes)):
            where_box = f"{place}.annos.boxes_3d[{k}]"
            if not isinstance(box, list) or len(box) != 7:
                raise BeamboxError(f"{where_box}: expected 7 numbers x y z l w h yaw")
            yield str(frame["frame_id"]), str(name), _floats(box, where_box), where_box
