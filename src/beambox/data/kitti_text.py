"""KITTI's text files: labels, results and road planes, parsed and formatted (KITTI devkit)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.kitti_calibration import finite_numbers, format_calibration, parse_calibration, read_calibration
from beambox.file_names import name_to_word, word_to_name
from beambox.geometry import Calibration
from beambox.io import read_text
from beambox.structures import Detections, ImageAttributes, Labels

__all__ = [
    "DONT_CARE",
    "format_calibration",
    "format_labels",
    "parse_calibration",
    "parse_labels",
    "parse_plane",
    "parse_results",
    "read_calibration",
    "read_labels",
    "read_results",
]

DONT_CARE = "DontCare"
LABEL_COLUMNS = 15
RESULT_COLUMNS = 16
FARTHEST = 1e9
"""No number of a label file is larger than this."""


@dataclass(frozen=True)
class _Rows:
    """Lines of a label or result file, objects and DontCare regions apart."""

    names: tuple[str, ...]
    columns: np.ndarray  # (N, 15) float64: the 14 columns behind the name, and the score (NaN where there is none)
    ignored: np.ndarray  # (K, 4) float64 image boxes of DontCare


def parse_labels(text: str, calibration: Calibration, where: str = "labels") -> Labels:
    """Parse a label file.

    DontCare lines become :attr:`Labels.ignored_image`; the camera-frame numbers are kept, as written, in
    :attr:`ImageAttributes.camera`. A score (a 16th column) is allowed and dropped.

    Args:
        text: content of the file.
        calibration: of the frame.
        where: what to call the file in messages.

    Raises:
        BeamboxError: naming the line, if one has a wrong number of columns, is not numeric or not finite.
    """
    rows = _parse_rows(text, where, (LABEL_COLUMNS, RESULT_COLUMNS))
    return Labels(_boxes(rows, calibration), rows.names, _attributes(rows), torch.from_numpy(rows.ignored).float())


def read_labels(path: Path, calibration: Calibration) -> Labels:
    """Read a label file; see :func:`parse_labels`."""
    return parse_labels(read_text(path), calibration, str(path))


def parse_results(
    text: str,
    calibration: Calibration,
    classes: Sequence[str] | None = None,
    where: str = "results",
    frame_id: str = "",
) -> Detections:
    """Parse a result file: label lines with a score as 16th column.

    Args:
        text: content of the file.
        calibration: of the frame.
        classes: names that may occur, in the detector's order; None takes those that occur, sorted.
        where: what to call the file in messages.
        frame_id: name of the frame.

    Returns:
        Detections in the LiDAR frame, in the file's order.
    """
    rows = _parse_rows(text, where, (RESULT_COLUMNS,))
    known = tuple(sorted(set(rows.names)) if classes is None else classes)
    place = {name: i for i, name in enumerate(known)}
    for name in rows.names:
        if name not in place:
            raise BeamboxError(f'{where}: unknown class "{name}"{did_you_mean(name, known)}')
    labels = torch.tensor([place[name] for name in rows.names], dtype=torch.int64)
    scores = torch.from_numpy(rows.columns[:, 14]).float()
    return Detections(_boxes(rows, calibration).float(), scores, labels, known, frame_id)


def read_results(path: Path, calibration: Calibration, classes: Sequence[str] | None = None) -> Detections:
    """Read a result file; see :func:`parse_results`."""
    return parse_results(read_text(path), calibration, classes, str(path), path.stem)


def format_labels(labels: Labels, calibration: Calibration, image_size: tuple[int, int] | None = None) -> str:
    """Write a label file's text: objects in order, then DontCare regions; inverse of :func:`parse_labels`.

    What the labels do not know is computed from the boxes: the camera-frame numbers, and without attributes the image
    box and the observation angle as well; truncation and occlusion are then written as 0.

    Args:
        labels: boxes in the LiDAR frame.
        calibration: of the frame.
        image_size: (width, height) to which computed image boxes are clipped.
    """
    attributes = labels.attributes
    camera = None if attributes is None else attributes.camera
    if camera is None or attributes is None:
        seen = calibration.to_camera(labels.boxes, image_size)
        camera = torch.cat((seen.size, seen.location, seen.rotation_y[:, None]), dim=1)  # (N, 7)
        if attributes is None:
            zeros = torch.zeros(len(labels), dtype=torch.int64)
            attributes = ImageAttributes(zeros.double(), zeros, seen.alpha, seen.image, camera)
    middle = torch.cat((attributes.alpha[:, None].double(), attributes.image.double(), camera), dim=1)  # (N, 12)
    lines = [
        f"{name_to_word(name, DONT_CARE)} {cut:.2f} {hidden} " + " ".join(f"{value:.2f}" for value in row)
        for name, cut, hidden, row in zip(
            labels.names, attributes.truncation.tolist(), attributes.occlusion.tolist(), middle.tolist()
        )
    ]
    lines += [
        f"{DONT_CARE} -1 -1 -10 " + " ".join(f"{value:.2f}" for value in row) + " -1 -1 -1 -1000 -1000 -1000 -10"
        for row in labels.ignored_image.tolist()
    ]
    return "".join(line + "\n" for line in lines)


def parse_plane(text: str, calibration: Calibration, where: str = "plane") -> Tensor:
    """Parse a road plane file: the last line holds a, b, c, d in the rectified camera frame.

    Returns:
        ``(4,)`` float32 plane in the LiDAR frame, unit normal pointing up.
    """
    lines = text.splitlines()
    filled = [number for number, line in enumerate(lines, start=1) if line.strip()]
    words = lines[filled[-1] - 1].split() if filled else []
    place = f"{where}, line {filled[-1]}" if filled else where
    values = finite_numbers(words, place)
    if len(values) != 4:
        raise BeamboxError(f"{place}: expected 4 numbers a b c d of the road plane, got {len(values)}")
    plane = torch.tensor(values, dtype=torch.float64)
    # n . (R x + t) + d = 0  <=>  (R^T n) . x + (n . t + d) = 0
    plane = plane @ calibration.lidar_to_rect_matrix
    length = plane[:3].norm()
    if length < 1e-9 or plane[2].abs() < 0.1 * length:
        raise BeamboxError(f"{place}: expected the plane of a road, got one that stands upright: {' '.join(words)}")
    return (plane / (length * plane[2].sign())).float()


def _parse_rows(text: str, where: str, columns: tuple[int, ...]) -> _Rows:
    names, rows, ignored = [], [], []
    wanted = " or ".join(str(count) for count in columns)
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        place = f"{where}, line {number}"
        if len(words) not in columns:
            raise BeamboxError(f"{place}: expected {wanted} columns, got {len(words)}")
        values = finite_numbers(words[1:], place)
        if max(map(abs, values)) > FARTHEST:
            raise BeamboxError(f"{place}: expected metres, pixels and radians, got {max(values, key=abs):g}")
        if words[0].lower() == DONT_CARE.lower():
            ignored.append(values[3:7])
            continue
        if min(values[7:10]) < 0:
            raise BeamboxError(
                f"{place}: height, width and length (columns 9 to 11) must be at least 0, got {' '.join(words[8:11])}"
            )
        names.append(word_to_name(words[0]))
        rows.append(values if len(values) == LABEL_COLUMNS else [*values, math.nan])
    return _Rows(
        tuple(names),
        np.array(rows, dtype=np.float64).reshape(-1, LABEL_COLUMNS),
        np.array(ignored, dtype=np.float64).reshape(-1, 4),
    )


def _boxes(rows: _Rows, calibration: Calibration) -> Tensor:
    columns = torch.from_numpy(rows.columns)
    return calibration.from_camera(columns[:, 10:13], columns[:, 7:10], columns[:, 13])  # (N, 7)


def _attributes(rows: _Rows) -> ImageAttributes:
    columns = torch.from_numpy(rows.columns)
    return ImageAttributes(
        truncation=columns[:, 0].clone(),
        occlusion=columns[:, 1].long(),
        alpha=columns[:, 2].clone(),
        image=columns[:, 3:7].clone(),
        camera=columns[:, 7:14].clone(),
    )
