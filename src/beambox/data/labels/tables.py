"""Label formats with a line per box: OpenPCDet's and MMDetection3D's text, CSV with usual names, PandaSet's columns.

* OpenPCDet (docs/CUSTOM_DATASET_TUTORIAL.md): ``x y z dx dy dz heading name``, z at the center.
* MMDetection3D (docs/en/advanced_guides/customize_dataset.md): ``x y z dx dy dz yaw name``; z is that of the bottom, as
  its LiDARInstance3DBoxes take it.
* PandaSet (pandaset-devkit, annotations.Cuboids): columns position.x ..., dimensions.x (width), .y (length), .z, yaw
  from +y. The devkit's own files are pickles, which run code when loaded; export them by ``DataFrame.to_csv``.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.labels.frames import LabeledFrame, Reader
from beambox.geometry.angles import wrap

__all__ = ["format_csv", "format_pandaset", "format_text", "parse_csv", "parse_pandaset", "parse_text"]

NUMBERS = ("x", "y", "z", "l", "w", "h", "yaw")
SYNONYMS = {
    "name": (
        "name",
        "label",
        "class",
        "class_name",
        "classname",
        "type",
        "category",
        "category_name",
        "obj_type",
        "object_type",
    ),
    "frame": ("frame", "frame_id", "frame_name", "frameid", "scan", "sweep", "sample", "file", "filename", "timestamp"),
    "id": ("id", "track_id", "trackid", "object_id", "obj_id", "instance_id", "instance", "uuid", "track"),
    "x": ("x", "cx", "center_x", "centre_x", "x_center", "position.x", "position_x", "pos_x", "px", "tx"),
    "y": ("y", "cy", "center_y", "centre_y", "y_center", "position.y", "position_y", "pos_y", "py", "ty"),
    "z": ("z", "cz", "center_z", "centre_z", "z_center", "position.z", "position_z", "pos_z", "pz", "tz"),
    "l": ("l", "length", "dx", "size_x", "length_m", "len", "scale_x", "dim_x"),
    "w": ("w", "width", "dy", "size_y", "width_m", "wid", "scale_y", "dim_y"),
    "h": ("h", "height", "dz", "size_z", "height_m", "scale_z", "dim_z"),
    "yaw": (
        "yaw",
        "heading",
        "theta",
        "rotation",
        "rotation_z",
        "rot_z",
        "rz",
        "orientation",
        "angle",
        "yaw_rad",
        "heading_rad",
    ),
}
DEGREES = (
    "yaw_deg",
    "yaw_degrees",
    "heading_deg",
    "heading_degrees",
    "rotation_deg",
    "angle_deg",
    "yaw(deg)",
    "yaw (deg)",
)
PANDASET = ("position.x", "position.y", "position.z", "dimensions.y", "dimensions.x", "dimensions.z", "yaw")
"""PandaSet's columns in the order x, y, z, l, w, h, yaw."""


def parse_text(text: str, reader: Reader, frame: str, *, bottom: bool = False) -> None:
    """Read ``x y z dx dy dz yaw name``; z is that of the bottom where asked."""
    reader.frame(frame)
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 8:
            raise BeamboxError(
                f"{reader.where}, line {number}: expected x y z dx dy dz yaw name, got {len(words)} columns"
            )
        numbers: list[object] = list(words[:7])
        if bottom:
            try:
                numbers[2] = float(words[2]) + float(words[5]) / 2
            except ValueError:
                pass  # said by add
        reader.add(frame, " ".join(words[7:]), numbers, f"line {number}")


def format_text(frame: LabeledFrame, *, bottom: bool = False) -> str:
    """Write ``x y z dx dy dz yaw name``."""
    lines = []
    for name, box in zip(frame.names, frame.boxes.tolist()):
        if bottom:
            box[2] -= box[5] / 2
        lines.append(" ".join([*(repr(value) for value in box), name]) + "\n")
    return "".join(lines)


def parse_csv(text: str, reader: Reader, frame: str) -> None:
    """Read a table with a header: any usual names, parted by comma, semicolon, tab or ``|``.

    Where no comma parts the columns, numbers may have decimal commas.

    Raises:
        BeamboxError: if a column is not there, or a row has another number of them.
    """
    header, rows = _table(text, reader.where)
    columns = _columns(header, reader)
    if "frame" not in columns:
        reader.frame(frame)
    for number, row in rows:
        own = str(row[columns["frame"]]) if "frame" in columns else frame
        numbers = [row[columns[key]] for key in NUMBERS]
        identity = row[columns["id"]] if "id" in columns else ""
        reader.frame(own)
        reader.add(own, row[columns["name"]], numbers, f"line {number}", identity)


def format_csv(frames: Mapping[str, LabeledFrame]) -> str:
    """Write all frames as one table: frame, name, x, y, z, l, w, h, yaw, id. Frames without a box are not in it."""
    return _write(
        ("frame", "name", *NUMBERS, "id"),
        (
            (frame, name, *map(repr, box), identity)
            for frame, found in frames.items()
            for name, box, identity in zip(found.names, found.boxes.tolist(), found.ids or ("",) * len(found))
        ),
    )


def parse_pandaset(text: str, reader: Reader, frame: str) -> None:
    """Read the columns of PandaSet's devkit as CSV."""
    header, rows = _table(text, reader.where)
    place = {name: k for k, name in enumerate(header)}
    for wanted in ("label", *PANDASET):
        if wanted not in place:
            raise BeamboxError(
                f"{reader.where}, line 1: there is no column `{wanted}`{did_you_mean(wanted, header)}; expected those "
                "of pandaset-devkit's cuboids"
            )
    reader.frame(frame)
    quarter = 90.0 if reader.degrees else math.pi / 2
    for number, row in rows:
        numbers: list[object] = [row[place[name]] for name in PANDASET]
        try:
            numbers[6] = float(str(numbers[6])) + quarter
        except ValueError:
            pass  # said by add
        reader.add(frame, row[place["label"]], numbers, f"line {number}", row[place["uuid"]] if "uuid" in place else "")


def format_pandaset(frame: LabeledFrame) -> str:
    """Write the columns of PandaSet's devkit as CSV."""
    rows = []
    for name, box, identity in zip(frame.names, frame.boxes.tolist(), frame.identities()):
        x, y, z, length, width, height, yaw = box
        numbers = (wrap(yaw - math.pi / 2), x, y, z, width, length, height)
        rows.append((identity, name, *map(repr, numbers)))
    head = ("uuid", "label", "yaw", "position.x", "position.y", "position.z")
    return _write((*head, "dimensions.x", "dimensions.y", "dimensions.z"), rows)


def _write(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(list(header))
    writer.writerows(list(row) for row in rows)
    return text.getvalue()


def _table(text: str, where: str) -> tuple[list[str], Iterable[tuple[int, list[str]]]]:
    """Split a table; the header decides what stands between columns."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    if not first:
        raise BeamboxError(f"{where} is empty; expected a header line with name, x, y, z, l, w, h, yaw")
    mark = max(",;\t|", key=first.count)
    reader = csv.reader(io.StringIO(text), delimiter=mark)
    header: list[str] | None = None
    rows: list[tuple[int, list[str]]] = []
    for words in reader:
        cells = [word.strip() for word in words]
        if not any(cells):
            continue
        if header is None:
            header = [cell.strip().lower() for cell in cells]
            continue
        if len(cells) != len(header):
            raise BeamboxError(
                f"{where}, line {reader.line_num}: expected {len(header)} columns as in the header, got {len(cells)}"
            )
        if mark != ",":
            cells = [cell.replace(",", ".") if _decimal_comma(cell) else cell for cell in cells]
        rows.append((reader.line_num, cells))
    return header or [], rows


def _decimal_comma(cell: str) -> bool:
    whole, comma, rest = cell.partition(",")
    return bool(comma) and whole.lstrip("+-").isdecimal() and rest.isdecimal()


def _columns(header: list[str], reader: Reader) -> dict[str, int]:
    """Find the columns by their usual names."""
    place = {name: k for k, name in reversed(list(enumerate(header)))}
    if "dimensions.x" in place and "dimensions.y" in place:
        raise BeamboxError(f"{reader.where} has PandaSet's columns, whose axes differ: read it as pandaset_columns")
    found: dict[str, int] = {}
    for wanted, names in SYNONYMS.items():
        match = next((place[name] for name in names if name in place), None)
        if match is None and wanted == "yaw":
            match = next((place[name] for name in DEGREES if name in place), None)
            reader.degrees = reader.degrees or match is not None
        if match is not None:
            found[wanted] = match
        elif wanted not in ("frame", "id"):
            raise BeamboxError(
                f"{reader.where}, line 1: there is no column `{wanted}`{did_you_mean(wanted, header)}; known names: "
                f"{', '.join(names)}"
            )
    return found
