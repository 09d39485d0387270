"""Where the sensor was: poses as files have them, and boxes carried by them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.geometry import Calibration
from beambox.io import read_text

__all__ = ["Poses", "as_pose", "carry_boxes", "carry_vectors", "read_poses"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Poses:
    """Poses of successive sweeps."""

    matrices: Floats
    """``(F, 4, 4)`` from the LiDAR frame of each sweep to a fixed frame, metres."""
    times: Floats | None = None
    """``(F,)`` seconds, where the file has them."""

    def __len__(self) -> int:
        return len(self.matrices)


def read_poses(path: Path | str, calibration: Calibration | None = None) -> Poses:
    """Read poses, one sweep per line.

    * 12 numbers: the rows of a ``(3, 4)`` matrix (KITTI odometry, and what KISS-ICP writes);
    * 16 numbers: the rows of a ``(4, 4)`` matrix;
    * 8 numbers: time, x, y, z and a quaternion qx, qy, qz, qw (TUM). Lines that begin with # are left out.

    Args:
        path: the text file.
        calibration: given where the poses are those of KITTI's camera 0, as in its odometry benchmark; they are then
            carried to the LiDAR.

    Raises:
        BeamboxError: naming the line that is no pose.
    """
    path = Path(path)
    matrices, times = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}, line {number}"
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise BeamboxError(f"{where}: a pose is 12, 16 or 8 numbers, got {line[:60]!r}") from None
        if len(values) == 8:
            times.append(values[0])
            matrices.append(_from_quaternion(values[1:], where))
        elif len(values) in (12, 16):
            matrices.append(as_pose(np.array(values).reshape(-1, 4), where))
        else:
            raise BeamboxError(f"{where}: a pose is 12, 16 or 8 numbers, got {len(values)}")
    if not matrices:
        raise BeamboxError(f"{path} must hold poses, one per line, but is empty")
    if times and len(times) != len(matrices):
        raise BeamboxError(f"{path}: all lines must have a time, or none")
    stacked = np.stack(matrices)
    if calibration is not None:
        camera = np.eye(4)
        camera[:3] = calibration.velo_to_cam.numpy()
        stacked = np.linalg.inv(camera) @ stacked @ camera
    return Poses(stacked, np.array(times) if times else None)


def as_pose(pose: Tensor | Floats | Sequence | None, where: str = "a pose") -> Floats:
    """Return a ``(4, 4)`` rigid motion; the identity for None.

    Raises:
        BeamboxError: if it is none.
    """
    if pose is None:
        return np.eye(4)
    try:
        given = np.asarray(pose.detach().cpu() if isinstance(pose, Tensor) else pose, dtype=np.float64)
    except (TypeError, ValueError):
        raise BeamboxError(f"{where} must be a (4, 4) or (3, 4) matrix of numbers") from None
    if given.shape not in ((3, 4), (4, 4)):
        raise BeamboxError(f"{where} must be a (4, 4) or (3, 4) matrix, got shape {given.shape}")
    matrix = np.eye(4)
    matrix[:3] = given[:3]
    turn = matrix[:3, :3]
    if not np.isfinite(matrix).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
        raise BeamboxError(f"{where} must be a rotation and a translation, but its first three columns do not rotate")
    if given.shape[0] == 4 and not np.allclose(given[3], [0, 0, 0, 1], atol=1e-6):
        raise BeamboxError(f"{where} must end in the row 0 0 0 1, got {given[3].tolist()}")
    return matrix


def carry_boxes(boxes: Floats, matrix: Floats) -> Floats:
    """Carry ``(N, 7)`` boxes by a ``(4, 4)`` rigid motion; the heading follows as in BEV."""
    heading = np.stack((np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))), axis=1) @ matrix[:3, :3].T
    out = boxes.copy()
    out[:, :3] = boxes[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]
    out[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    return out


def carry_vectors(vectors: Floats, matrix: Floats) -> Floats:
    """Turn ``(N, 3)`` vectors as a rigid motion turns."""
    return vectors @ matrix[:3, :3].T


def _from_quaternion(values: Sequence[float], where: str) -> Floats:
    x, y, z, qx, qy, qz, qw = values
    length = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if not math.isfinite(length) or abs(length - 1) > 1e-2:
        raise BeamboxError(f"{where}: a quaternion must have length 1, got {length:g}")
    qx, qy, qz, qw = (value / length for value in (qx, qy, qz, qw))
    return as_pose(
        [
            [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qz + qy * qw), x],
            [2 * (qx * qy + qz * qw), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qx * qw), y],
            [2 * (qx * qz - qy * qw), 2 * (qy * qz + qx * qw), 1 - 2 * (qx * qx + qy * qy), z],
        ],
        where,
    )
