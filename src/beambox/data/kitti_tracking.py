"""KITTI's tracking text: one file per drive, ``frame id type``, then the columns of an object label [and a score]."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError
from beambox.geometry import Calibration
from beambox.io import read_text

__all__ = ["DONT_CARE", "TrackedObjects", "format_tracking", "parse_tracking", "read_tracking"]

Floats = NDArray[np.float64]
DONT_CARE = "DontCare"
COLUMNS = 17
FARTHEST = 1e9


@dataclass(frozen=True)
class TrackedObjects:
    """The objects of one frame with identities; N objects, K regions that nobody labelled."""

    ids: NDArray[np.int64]
    """``(N,)``."""
    names: tuple[str, ...]
    """Class of each."""
    boxes: Floats
    """``(N, 7)`` x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""
    image: Floats
    """``(N, 4)`` left, top, right, bottom in pixels."""
    truncation: Floats
    """``(N,)`` 0 not truncated; above that, partly or largely (tracking labels count 0, 1, 2)."""
    occlusion: NDArray[np.int64]
    """``(N,)`` 0 visible, 1 partly, 2 largely, 3 unknown."""
    scores: Floats
    """``(N,)`` NaN where the file has none."""
    ignored: Floats
    """``(K, 4)`` image boxes of DontCare."""

    def __len__(self) -> int:
        return len(self.ids)


def read_tracking(path: Path, calibration: Calibration) -> dict[int, TrackedObjects]:
    """Read a label or result file; see :func:`parse_tracking`."""
    return parse_tracking(read_text(path), calibration, str(path))


def parse_tracking(text: str, calibration: Calibration, where: str = "tracks") -> dict[int, TrackedObjects]:
    """Parse labels (17 columns) or results (18, the last a score) of one drive.

    Args:
        text: content of the file.
        calibration: of the drive.
        where: what to call it in messages.

    Returns:
        Frame number -> objects; a frame without a line is absent.

    Raises:
        BeamboxError: naming the line, if one has a wrong number of columns or is no number, or a frame has an identity
            twice.
    """
    frames: dict[int, list[tuple[int, str, list[float]]]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        place = f"{where}, line {number}"
        if len(words) not in (COLUMNS, COLUMNS + 1):
            raise BeamboxError(
                f"{place}: expected frame, id, type and {COLUMNS - 3} numbers, and perhaps a score; "
                f"got {len(words)} columns"
            )
        frame, identity = _whole(words[0], place, "frame"), _whole(words[1], place, "id")
        frames.setdefault(frame, []).append((identity, words[2], _numbers(words[3:], place)))
    return {frame: _objects(rows, calibration, f"{where}, frame {frame}") for frame, rows in sorted(frames.items())}


def format_tracking(
    frame: int,
    ids: Iterable[int],
    names: Iterable[str],
    boxes: torch.Tensor,
    scores: Iterable[float],
    calibration: Calibration,
    image_size: tuple[int, int] | None = None,
) -> str:
    """Write the result lines of one frame.

    Args:
        frame: its number in the drive.
        ids: of the N objects.
        names: their classes.
        boxes: ``(N, 7)`` in the LiDAR frame.
        scores: of each.
        calibration: of the drive.
        image_size: (width, height) to clip the image boxes to.
    """
    seen = calibration.to_camera(boxes, image_size)
    columns = torch.cat(
        (seen.alpha[:, None], seen.image, seen.size, seen.location, seen.rotation_y[:, None]), dim=1
    ).tolist()  # N x 12
    return "".join(
        f"{frame} {identity} {name} -1 -1 {' '.join(f'{value:.6f}' for value in row)} {score:.6f}\n"
        for identity, name, row, score in zip(ids, names, columns, scores)
    )


def _whole(word: str, place: str, what: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise BeamboxError(f'{place}: the {what} must be a whole number, got "{word[:40]}"') from None


def _numbers(words: list[str], place: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise BeamboxError(f"{place}: expected numbers behind the type, got {' '.join(words)[:80]!r}") from None
    if not all(math.isfinite(value) and abs(value) <= FARTHEST for value in values):
        raise BeamboxError(f"{place}: expected finite metres, pixels and radians")
    return values if len(values) > COLUMNS - 3 else [*values, math.nan]


def _objects(rows: list[tuple[int, str, list[float]]], calibration: Calibration, where: str) -> TrackedObjects:
    ignored = [values[3:7] for _, name, values in rows if name == DONT_CARE]
    kept = [row for row in rows if row[1] != DONT_CARE]
    ids = [identity for identity, _, _ in kept]
    if len(set(ids)) < len(ids):
        twice = next(identity for identity in ids if ids.count(identity) > 1)
        raise BeamboxError(f"{where}: the identity {twice} stands there twice")
    columns = np.array([values for _, _, values in kept], dtype=np.float64).reshape(-1, 15)
    given = torch.from_numpy(columns)
    return TrackedObjects(
        ids=np.array(ids, dtype=np.int64),
        names=tuple(name for _, name, _ in kept),
        boxes=calibration.from_camera(given[:, 10:13], given[:, 7:10], given[:, 13]).numpy(),
        image=columns[:, 3:7],
        truncation=columns[:, 0],
        occlusion=columns[:, 1].astype(np.int64),
        scores=columns[:, 14],
        ignored=np.array(ignored, dtype=np.float64).reshape(-1, 4),
    )
