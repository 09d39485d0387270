"""The boxes of one frame as KITTI's evaluator sees them, from text lines, from files or from memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError, MissingFileError
from beambox.file_names import read_names
from beambox.geometry.calibration import Calibration, CameraBoxes
from beambox.io import read_text
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = [
    "Objects",
    "objects_from_detections",
    "objects_from_labels",
    "parse_objects",
    "read_frame_list",
    "read_pairs",
]

Floats = NDArray[np.float64]
LABEL_COLUMNS = "type truncated occluded alpha left top right bottom h w l X Y Z ry"


@dataclass(frozen=True)
class Objects:
    """Columns of a label or result file; N objects."""

    names: tuple[str, ...]
    """Class of each, lower case."""
    box: Floats
    """``(N, 7)`` x, y, z, l, w, h, yaw in any right-handed frame whose z points up and that both sides share."""
    score: Floats
    """``(N,)``; zeros for ground truth."""
    image: Floats
    """``(N, 4)`` left, top, right, bottom, pixels; zeros where there is no camera."""
    truncation: Floats
    """``(N,)``."""
    occlusion: Floats
    """``(N,)``."""
    alpha: Floats
    """``(N,)`` radians; -10 where it is not known."""
    ignored_image: Floats
    """``(K, 4)`` DontCare regions, pixels."""
    has_camera: bool = True
    """Whether the image columns mean anything."""

    def __len__(self) -> int:
        return len(self.names)


def _planar(location: Floats, size: Floats, rotation_y: Floats) -> Floats:
    """Turn camera boxes, bottom centre and (h, w, l), into boxes over the plane (X, Z): ``(N, 7)``.

    KITTI's corner for a along l and b along w is (X + a cos ry + b sin ry, Z - a sin ry + b cos ry), a rotation of the
    plane (X, Z) by -ry; the axis that points up is -Y.
    """
    height, width, length = size.T
    up = height / 2 - location[:, 1]
    return np.stack((location[:, 0], location[:, 2], up, length, width, height, -rotation_y), axis=1)


def parse_objects(text: str, where: str, scored: bool) -> Objects:
    """Read the lines of a label file, or of a result file.

    Args:
        text: content of the file.
        where: what errors call the file.
        scored: whether each line ends with a score.

    Raises:
        BeamboxError: naming the file and the line.
    """
    names, rows, ignored = [], [], []
    wanted = 16 if scored else 15
    for number, line in enumerate(text.splitlines(), start=1):
        parts = line.split()
        if not parts:
            continue
        if len(parts) < wanted or len(parts) > 16:
            kind = "result" if scored else "label"
            raise BeamboxError(
                f"{where}, line {number}: a {kind} line has {wanted} columns "
                f"({LABEL_COLUMNS}{' score' if scored else ''}), got {len(parts)}"
            )
        try:
            values = [float(part) for part in parts[1:wanted]]
        except ValueError as error:
            raise BeamboxError(f"{where}, line {number}: expected numbers after the type, {error}") from error
        if not all(map(math.isfinite, values)):
            raise BeamboxError(f"{where}, line {number}: expected finite numbers, got {line.strip()!r}")
        if parts[0].lower() == "dontcare":
            ignored.append(values[3:7])
            continue
        names.append(parts[0].lower())
        rows.append(values)
    table = np.array(rows, dtype=np.float64).reshape(-1, wanted - 1)
    return Objects(
        names=tuple(names),
        box=_planar(table[:, 10:13], table[:, 7:10], table[:, 13]),
        score=table[:, 14] if scored else np.zeros(len(names)),
        image=table[:, 3:7],
        truncation=table[:, 0],
        occlusion=table[:, 1],
        alpha=table[:, 2],
        ignored_image=np.array(ignored, dtype=np.float64).reshape(-1, 4),
    )


def _from_camera(camera: CameraBoxes) -> tuple[Floats, Floats, Floats]:
    location, size, turn = (part.double().numpy() for part in (camera.location, camera.size, camera.rotation_y))
    return _planar(location, size, turn), camera.image.double().numpy(), camera.alpha.double().numpy()


def objects_from_labels(labels: Labels, calibration: Calibration | None) -> Objects:
    """Take over ground truth; with a calibration into the camera's plane, as the official evaluator has it."""
    boxes = labels.boxes.double()
    size = len(labels)
    box, image, alpha = boxes.numpy(), np.zeros((size, 4)), np.full(size, -10.0)
    truncation, occlusion = np.zeros(size), np.zeros(size)
    attributes = labels.attributes
    if calibration is not None:
        box = _from_camera(calibration.to_camera(boxes))[0]
        if attributes is not None and attributes.camera is not None:  # exactly as the label file has it
            size_there, location, turn = attributes.camera.double().split((3, 3, 1), dim=1)
            box = _planar(location.numpy(), size_there.numpy(), turn[:, 0].numpy())
    if attributes is not None:
        truncation, occlusion = attributes.truncation.double().numpy(), attributes.occlusion.double().numpy()
        image, alpha = attributes.image.double().numpy(), attributes.alpha.double().numpy()
    return Objects(
        names=tuple(name.lower() for name in labels.names),
        box=box,
        score=np.zeros(size),
        image=image,
        truncation=truncation,
        occlusion=occlusion,
        alpha=alpha,
        ignored_image=labels.ignored_image.double().numpy(),
        has_camera=calibration is not None and (attributes is not None or size == 0),
    )


def objects_from_detections(
    detections: Detections, calibration: Calibration | None, image_size: tuple[int, int] | None
) -> Objects:
    """Take over detections; with a calibration their image boxes and observation angles are computed.

    Args:
        detections: of one frame.
        calibration: of the frame, or None for data without a camera.
        image_size: (width, height) to clip the image boxes to.
    """
    size = len(detections)
    boxes = detections.boxes.detach().cpu().double()
    box, image, alpha = boxes.numpy(), np.zeros((size, 4)), np.full(size, -10.0)
    if calibration is not None:
        box, image, alpha = _from_camera(calibration.to_camera(boxes, image_size))
    score = detections.scores.detach().cpu().double().numpy()
    if not (np.isfinite(score).all() and np.isfinite(box).all()):
        raise BeamboxError(f"detections of frame {detections.frame_id or '(unnamed)'} hold NaN or infinite values")
    return Objects(
        names=tuple(name.lower() for name in detections.names),
        box=box,
        score=score,
        image=image,
        truncation=np.zeros(size),
        occlusion=np.zeros(size),
        alpha=alpha,
        ignored_image=np.zeros((0, 4)),
        has_camera=calibration is not None,
    )


def _folder(folder: Path, inner: Sequence[str], what: str) -> Path:
    """Accept the folder of the text files itself or one above it, as data sets and KITTI's evaluator lay them out."""
    if not folder.is_dir():
        raise MissingFileError(f"the folder of {what}, {folder}, does not exist")
    if any(folder.glob("*.txt")):
        return folder
    for name in inner:
        if (folder / name).is_dir():
            return folder / name
    return folder


def read_frame_list(path: Path) -> list[str]:
    """Read frame names, one per line, as ImageSets/val.txt has them.

    Raises:
        BeamboxError: if the list is not there, empty, or names a frame twice.
    """
    if not path.is_file():
        raise MissingFileError(f"the list of frames {path} does not exist; it holds one frame name a line")
    return read_names(path)


def read_pairs(
    labels: Path, results: Path, frames: Sequence[str] | None = None, allow_missing: bool = False
) -> list[tuple[Objects, Objects]]:
    """Read label and result files.

    Args:
        labels: folder of label files, or a KITTI root above ``training/label_2``.
        results: folder of result files, one per frame (an empty file: nothing found), or the folder above ``data``.
        frames: names without suffix; None takes every label file.
        allow_missing: read a missing result file as an empty one.

    Raises:
        MissingFileError: if a label or result file is absent.
        BeamboxError: if a line cannot be read.
    """
    labels = _folder(labels, ("label_2", "training/label_2"), "labels")
    results = _folder(results, ("data",), "results")
    names = sorted(path.stem for path in labels.glob("*.txt")) if frames is None else list(frames)
    if not names:
        raise BeamboxError(f"there is nothing to score: {labels} holds no label file <frame>.txt")
    repeated = next((name for name, count in Counter(names).items() if count > 1), None)
    if repeated is not None:
        raise BeamboxError(f"the frames to score must be named once each, but {repeated} is named again")
    have = {path.stem for path in results.glob("*.txt")}
    missing = [name for name in names if name not in have]
    if missing and not allow_missing:
        hint = " or score only the frames of a list, --frame-list ImageSets/val.txt" if frames is None else ""
        raise MissingFileError(
            f"{len(missing)} of {len(names)} frames have no result file in {results}, the first is {missing[0]}.txt; "
            f"write an empty file where nothing was found, pass --allow-missing{hint}"
        )
    pairs = []
    for name in names:
        label = labels / f"{name}.txt"
        if not label.is_file():
            raise MissingFileError(f"frame {name} has no label file {label}")
        result = results / f"{name}.txt"
        det = read_text(result) if name in have else ""
        pairs.append(
            (
                parse_objects(read_text(label), str(label), scored=False),
                parse_objects(det, str(result), scored=True),
            )
        )
    return pairs
