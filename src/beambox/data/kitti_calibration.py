"""KITTI's calibration files: of the object, tracking and odometry benchmarks and of the raw recordings, told by key.

What is read is looked at before it is believed: rotations rotate, lengths are metres, the camera looks ahead and stands
upright. Else boxes would land elsewhere without a word.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean
from beambox.geometry import Calibration
from beambox.io import read_text

__all__ = ["CALIBRATION_REMEDY", "finite_numbers", "format_calibration", "parse_calibration", "read_calibration"]

CALIBRATION_REMEDY = "boxes live in the camera's frame, so labels and the camera's view need it; points alone do not"
# the object benchmark's key first, then those of the tracking and odometry benchmarks and of the raw recordings
CALIBRATION_KEYS = {
    "P2": (("P2", "P_rect_02"), (3, 4)),
    "R0_rect": (("R0_rect", "R_rect", "R_rect_00", "R0"), (3, 3)),
    "Tr_velo_to_cam": (("Tr_velo_to_cam", "Tr_velo_cam", "Tr_velo2cam", "Tr"), (3, 4)),
}
LINE = re.compile(r"\s*([A-Za-z]\w*)\s*[:=\s]\s*(.*?)\s*")
ASKEW = 0.05
"""Rotations written with few digits differ from a true one by less than this."""
FARTHEST_CAMERA = 50.0
"""Metres between LiDAR and camera beyond which the unit is another; the longest vehicles have 20."""
ACROSS = 45.0
"""Degrees by which the camera may be turned from straight ahead and upright."""


def parse_calibration(text: str, where: str = "calibration") -> Calibration:
    """Parse a calib file by key; the order of lines and further keys do not matter.

    ``KEY: numbers``, ``KEY:numbers`` and ``KEY numbers`` are read, parted by blanks, tabs or commas; a 4 x 4 matrix
    whose last row is 0 0 0 1 is cut. The odometry benchmark's ``Tr`` leads into the rectified camera already, so it
    needs no ``R0_rect``; the raw recordings' ``R`` and ``T`` stand for ``Tr_velo_to_cam``.

    Args:
        text: content of the file.
        where: what to call it in messages, such as its path.

    Raises:
        BeamboxError: if P2, R0_rect or Tr_velo_to_cam is absent, has a wrong count of numbers, is not finite, or cannot
            be what it is called.
    """
    lines = _lines(text, where)
    if "R" in lines and "T" in lines and not any(name in lines for name in CALIBRATION_KEYS["Tr_velo_to_cam"][0]):
        rotation, shift = _matrix(lines, "R", (3, 3), where), _matrix(lines, "T", (3, 1), where)
        joined = torch.cat((rotation, shift), dim=1).flatten().tolist()
        lines["Tr_velo_to_cam"] = (lines["R"][0], [repr(value) for value in joined])
    if "Tr" in lines and not any(name in lines for name in CALIBRATION_KEYS["R0_rect"][0]):
        lines["R0_rect"] = (lines["Tr"][0], ["1", "0", "0", "0", "1", "0", "0", "0", "1"])
    matrices = []
    for key, (names, shape) in CALIBRATION_KEYS.items():
        found = next((name for name in names if name in lines), None)
        if found is None:
            hint = did_you_mean(key, lines)
            raise BeamboxError(f"{where}: expected a line `{key}:` with {math.prod(shape)} numbers, got none{hint}")
        matrices.append(_matrix(lines, found, shape, where))
    calibration = Calibration(*matrices)
    fault = _fault(calibration)
    if fault:
        raise BeamboxError(f"{where}: {fault}")
    return calibration


def _lines(text: str, where: str) -> dict[str, tuple[int, list[str]]]:
    """Return line number and words by key; a key that stands there twice with other numbers is refused."""
    lines: dict[str, tuple[int, list[str]]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        found = LINE.fullmatch(line)
        if found is None:
            continue
        key, words = found[1], re.sub(r"[,;\[\]()]", " ", found[2]).split()
        if key in lines and lines[key][1] != words:
            raise BeamboxError(f"{where}, line {number}: `{key}` stands in line {lines[key][0]} with other numbers")
        lines[key] = (number, words)
    return lines


def _matrix(lines: dict[str, tuple[int, list[str]]], key: str, shape: tuple[int, int], where: str) -> Tensor:
    number, words = lines[key]
    values = finite_numbers(words, f"{where}, line {number} ({key})")
    if len(values) == 16 and values[12:] == [0, 0, 0, 1]:
        return torch.tensor(values, dtype=torch.float64).reshape(4, 4)[: shape[0], : shape[1]]
    if len(values) != math.prod(shape):
        raise BeamboxError(
            f"{where}, line {number}: expected {math.prod(shape)} numbers for `{key}`, got {len(values)}"
        )
    return torch.tensor(values, dtype=torch.float64).reshape(shape)


def _fault(calibration: Calibration) -> str | None:
    """Return why three matrices can be no calibration of a LiDAR and a camera, or None."""
    turn, shift = calibration.velo_to_cam[:, :3], calibration.velo_to_cam[:, 3]
    for name, rotation in (("R0_rect", calibration.r0), ("Tr_velo_to_cam", turn)):
        askew = float((rotation @ rotation.T - torch.eye(3, dtype=rotation.dtype)).abs().max())
        if not askew <= ASKEW or not float(torch.linalg.det(rotation)) > 0:
            rows = "; ".join(" ".join(f"{value:.4g}" for value in row) for row in rotation.tolist())
            return f"expected rotations in `R0_rect` and `Tr_velo_to_cam`, but `{name}` has {rows}"
    if float(shift.abs().max()) > FARTHEST_CAMERA:
        details = " ".join(f"{value:.4g}" for value in shift.tolist())
        return f"expected metres in `Tr_velo_to_cam`, but it shifts by {details}; are these millimetres?"
    focal = calibration.p2[0, 0], calibration.p2[1, 1]
    depth = calibration.p2[2, :3]
    if not (min(focal) > 0 and float((depth - torch.tensor([0.0, 0, 1])).abs().max()) <= ASKEW):
        rows = "; ".join(" ".join(f"{value:.4g}" for value in row) for row in calibration.p2.tolist())
        return f"expected `P2` with positive focal lengths and a last row 0 0 1 t, but it has {rows}"
    if float(calibration.p2.abs().max()) > 1e7:
        return f"expected pixels in `P2`, got {float(calibration.p2.abs().max()):.4g}"
    whole = calibration.r0 @ turn
    ahead, up = math.cos(math.radians(ACROSS)), whole @ torch.tensor([0.0, 0, 1], dtype=whole.dtype)
    if float(-up[1]) < ahead:
        details = " ".join(f"{value:.2f}" for value in up.tolist())
        return (
            f"`Tr_velo_to_cam` must lead from the LiDAR (x forward, y left, z up) to the camera (x right, y down, "
            f"z forward), but it turns up into {details} instead of 0 -1 0; a placeholder is 0 -1 0 0 0 0 -1 0 1 0 0 0"
        )
    if float(whole[2, 0]) < ahead:
        details = " ".join(f"{value:.2f}" for value in whole[:, 0].tolist())
        return (
            f"the camera must look along the LiDAR's x within {ACROSS:.0f} degrees, since KITTI's headings are turned "
            f"by it, but forward becomes {details} instead of 0 0 1; turn the points so that x leads forward"
        )
    return None


def finite_numbers(words: Sequence[str], where: str) -> list[float]:
    """Turn words into finite numbers.

    Raises:
        BeamboxError: naming the word that is none.
    """
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            raise BeamboxError(f'{where}: expected numbers, got "{word[:40]}"') from None
        if not math.isfinite(value):
            raise BeamboxError(f'{where}: expected finite numbers, got "{word[:40]}"')
        values.append(value)
    return values


def read_calibration(path: Path) -> Calibration:
    """Read a calib file; see :func:`parse_calibration`."""
    return parse_calibration(read_text(path, CALIBRATION_REMEDY), str(path))


def format_calibration(calibration: Calibration) -> str:
    """Write a calib file's text; the cameras other than camera 2 get its matrix, the IMU the identity."""
    entries = [(f"P{camera}:", calibration.p2) for camera in range(4)]
    entries += [("R0_rect:", calibration.r0), ("Tr_velo_to_cam:", calibration.velo_to_cam)]
    entries += [("Tr_imu_to_velo:", torch.eye(3, 4, dtype=torch.float64))]
    return "".join(
        " ".join([key, *(f"{value:.12e}" for value in matrix.flatten().tolist())]) + "\n" for key, matrix in entries
    )
