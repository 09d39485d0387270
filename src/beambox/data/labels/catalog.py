"""The label formats by name: how each is read and written, and where its documentation is."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.labels import objects, sequences, tables
from beambox.data.labels.frames import LabeledFrame, Reader
from beambox.io import parse_json, read_text, write_text

__all__ = ["FORMATS", "LabelFormat", "label_format", "parse_labels", "read_labels", "write_labels"]

Frames = Mapping[str, LabeledFrame]


@dataclass(frozen=True)
class LabelFormat:
    """One format."""

    ending: str
    """Of its files."""
    read: Callable[[Any, Reader, str], None]
    """Reads a file's text (a table) or content (JSON) into a reader; the last argument is the frame's name."""
    write_frame: Callable[[LabeledFrame, str], Any] | None = None
    """Returns the content of a frame's file, where each frame has one."""
    write_all: Callable[[Frames], Any] | None = None
    """Returns the content of the one file."""
    degrees: bool = False
    """Whether angles are degrees."""
    source: str = ""
    """Where the format is documented."""


def _text(write: Callable[[LabeledFrame], str]) -> Callable[[LabeledFrame, str], str]:
    return lambda frame, name: write(frame)


FORMATS: dict[str, LabelFormat] = {
    "openpcdet": LabelFormat(
        ".txt",
        tables.parse_text,
        _text(tables.format_text),
        source="OpenPCDet, docs/CUSTOM_DATASET_TUTORIAL.md",
    ),
    "mmdet3d": LabelFormat(
        ".txt",
        partial(tables.parse_text, bottom=True),
        _text(partial(tables.format_text, bottom=True)),
        source="MMDetection3D, docs/en/advanced_guides/customize_dataset.md; boxes stand on z",
    ),
    "sustechpoints": LabelFormat(
        ".json",
        objects.parse_sustechpoints,
        lambda frame, name: objects.format_sustechpoints(frame),
        source="SUSTechPOINTS, label files",
    ),
    "labelcloud": LabelFormat(
        ".json",
        objects.parse_labelcloud,
        lambda frame, name: objects.format_labelcloud(frame, name, lambda yaw: math.degrees(yaw) % 360),
        degrees=True,
        source="labelCloud, centroid_abs (degrees); reads vertices too",
    ),
    "labelcloud_rel": LabelFormat(
        ".json",
        objects.parse_labelcloud,
        lambda frame, name: objects.format_labelcloud(frame, name, float),
        source="labelCloud, centroid_rel (radians)",
    ),
    "labelcloud_vertices": LabelFormat(
        ".json",
        objects.parse_labelcloud,
        lambda frame, name: objects.format_labelcloud(frame, name, None),
        source="labelCloud, docs/conventions.md, vertices",
    ),
    "supervisely": LabelFormat(
        ".json",
        objects.parse_supervisely,
        objects.format_supervisely,
        source="Supervisely annotation format, point clouds and episodes",
    ),
    "datumaro": LabelFormat(
        ".json",
        sequences.parse_datumaro,
        write_all=sequences.format_datumaro,
        source="Datumaro format, cuboid_3d (CVAT: Datumaro 3D)",
    ),
    "segments": LabelFormat(
        ".json",
        sequences.parse_segments,
        write_all=sequences.format_segments,
        source="Segments.ai, label types, cuboid",
    ),
    "scale": LabelFormat(
        ".json",
        sequences.parse_scale,
        write_all=sequences.format_scale,
        source="Scale, lidar callback format",
    ),
    "openlabel": LabelFormat(
        ".json",
        sequences.parse_openlabel,
        write_all=sequences.format_openlabel,
        source="ASAM OpenLABEL 1.0, cuboid",
    ),
    "pandaset_columns": LabelFormat(
        ".csv",
        tables.parse_pandaset,
        _text(tables.format_pandaset),
        source="pandaset-devkit, annotations.Cuboids",
    ),
    "table": LabelFormat(
        ".csv",
        tables.parse_csv,
        write_all=tables.format_csv,
        source="CSV with a header, any usual names",
    ),
}


def label_format(kind: str) -> LabelFormat:
    """Return a format by name.

    Raises:
        BeamboxError: if there is none of this name.
    """
    if kind not in FORMATS:
        raise BeamboxError(f'unknown label format "{kind}"{did_you_mean(kind, FORMATS)}')
    return FORMATS[kind]


def parse_labels(
    text: str, kind: str, where: str, frame: str = "", *, degrees: bool | None = None
) -> tuple[dict[str, LabeledFrame], list[str]]:
    """Read the labels of a file.

    Args:
        text: content of the file.
        kind: a name of :data:`FORMATS`.
        where: what to call the file in messages.
        frame: name of the frame, where the file does not say it.
        degrees: whether angles are degrees; as the format has it where None.

    Returns:
        Frame name -> boxes, and notes on what had to be decided.

    Raises:
        BeamboxError: naming the file and the line or entry.
    """
    form = label_format(kind)
    reader = Reader(where, form.degrees if degrees is None else degrees)
    form.read(parse_json(text, where) if form.ending == ".json" else text, reader, frame)
    return reader.result(), reader.notes


def read_labels(path: Path, kind: str, *, degrees: bool | None = None) -> tuple[dict[str, LabeledFrame], list[str]]:
    """Read a file, or all files of a folder (and of folders in it); a file's name is that of its frame.

    Raises:
        MissingFileError: if nothing is there.
        BeamboxError: naming the file and the line or entry, or a frame that two files hold.
    """
    form = label_format(kind)
    if not path.exists():
        raise MissingFileError(f"{path} is not there")
    files = sorted(path.rglob(f"*{form.ending}")) if path.is_dir() else [path]
    if not files:
        raise MissingFileError(f"{path} holds no label file (*{form.ending})")
    found: dict[str, LabeledFrame] = {}
    notes: list[str] = []
    for file in files:
        name = frame_name(file, path if path.is_dir() else file.parent)
        frames, new_notes = parse_labels(read_text(file), kind, str(file), name, degrees=degrees)
        twice = next((one for one in frames if one in found), None)
        if twice is not None:
            raise BeamboxError(f"{file}: the frame {twice} has labels in another file too")
        found.update(frames)
        notes += new_notes
    return found, notes


def frame_name(file: Path, root: Path) -> str:
    """Return the frame that a label file belongs to: its name without endings of its own and of the point cloud."""
    inside = file.relative_to(root)
    stem = inside.stem
    for ending in (".pcd", ".bin", ".ply", ".npy"):
        stem = stem.removesuffix(ending)
    return "/".join((*inside.parts[:-1], stem))


def write_labels(frames: Frames, kind: str, out: Path) -> list[Path]:
    """Write labels: one file, or a folder with one file per frame, as the format has it.

    Args:
        frames: frame name -> boxes.
        kind: a name of :data:`FORMATS`.
        out: the file, or the folder.

    Raises:
        BeamboxError: if the name of a frame leads out of the folder, or the file cannot be written.
    """
    form = label_format(kind)
    if form.write_all is not None:
        file = out if out.suffix else out / f"labels{form.ending}"
        write_text(file, _encode(form.write_all(frames)))
        return [file]
    if out.suffix and not out.is_dir():
        raise BeamboxError(f"{out} should be a folder: {kind} has one file per frame")
    assert form.write_frame is not None
    written = []
    for name, frame in frames.items():
        parts = [check_part(part, kind) for part in name.split("/")]
        file = out.joinpath(*parts[:-1], parts[-1] + form.ending)
        write_text(file, _encode(form.write_frame(frame, name)))
        written.append(file)
    return written


def check_part(part: str, kind: str) -> str:
    """Refuse a part of a frame's name that would lead elsewhere."""
    from beambox.file_names import check_file_name

    return check_file_name(part, f"a frame of the {kind} labels")


def _encode(content: Any) -> str:
    return content if isinstance(content, str) else json.dumps(content, indent=1, allow_nan=False) + "\n"
