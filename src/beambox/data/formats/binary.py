"""Raw float32 records (.bin), as KITTI, ONCE and nuScenes store sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.io import read_bytes

__all__ = ["read_bin"]

PRINTABLE = bytes(range(0x20, 0x7F)) + b"\t\r\n"
FARTHEST = 1e6
"""Coordinates beyond this many metres mean that the bytes are something else."""


def read_bin(path: Path, columns: int = 4) -> np.ndarray:
    """Read little-endian float32 records.

    Args:
        path: the file.
        columns: numbers a point; the first three are taken for coordinates.

    Returns:
        ``(N, columns)`` float32, writable; may hold NaN.

    Raises:
        BeamboxError: if the size is not a whole number of points, or the content is text or another number type.
    """
    content = read_bytes(path)
    head = content[:4096]
    if len(head) >= 8 and len(head.translate(None, PRINTABLE)) <= len(head) // 50:
        start = head[:30].decode("ascii", "replace")
        raise BeamboxError(
            f"{path} must hold binary float32 numbers, but is a text file (it begins {start!r}); "
            "give it the ending of its format, or write the points with numpy's tofile"
        )
    record = 4 * columns
    if len(content) % record:
        raise BeamboxError(
            f"{path} must hold whole points of {columns} float32 numbers ({record} bytes), but has {len(content)} "
            f"bytes, {len(content) % record} too many: it is cut short, or has another number of columns"
            f"{_other_columns(len(content), columns)}"
        )
    points = np.frombuffer(content, dtype="<f4").reshape(-1, columns).astype(np.float32)
    if _implausible(points[:, :3]):
        guess = np.frombuffer(content[: len(content) // 8 * 8], dtype="<f8")
        hint = ""
        if not _implausible(guess[:3000]):
            hint = "; it looks like float64: convert it with points.astype('float32').tofile(...)"
        raise BeamboxError(
            f"{path} must hold float32 x, y, z in metres, but most numbers are no sensible coordinates{hint}"
        )
    return points


def _implausible(numbers: np.ndarray) -> bool:
    """Tell whether more than a tenth of the numbers cannot be metres (NaN may be: sensors write it for no return)."""
    sample = numbers[:: max(1, len(numbers) // 2000)]
    magnitude = np.abs(sample.astype(np.float64))
    wrong = (magnitude > FARTHEST) | ((magnitude < 1e-20) & (magnitude > 0))
    return bool(wrong.sum() > 0.1 * wrong.size)


def _other_columns(size: int, columns: int) -> str:
    names = ("x", "y", "z", "intensity", "ring", "time")
    fitting = [count for count in range(3, 7) if count != columns and size % (4 * count) == 0]
    if not fitting:
        return ""
    return f' (for {fitting[-1]} columns give `fields`, such as "{",".join(names[: fitting[-1]])}")'
