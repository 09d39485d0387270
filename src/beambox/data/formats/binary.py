"""Raw float32 records (.bin), as KITTI and ONCE store sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.files import read_bytes

__all__ = ["read_bin"]

PRINTABLE = bytes(range(0x20, 0x7F)) + b"\t\r\n"


def read_bin(path: Path, columns: int = 4) -> np.ndarray:
    """Read little-endian float32 records.

    Args:
        path: the file.
        columns: numbers a point.

    Returns:
        ``(N, columns)`` float32, writable.

    Raises:
        BeamboxError: if the size is not a whole number of points, or the content is text.
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
            f"bytes, {len(content) % record} too many: it is cut short, or has another number of columns "
            "(name them by `fields`)"
        )
    return np.frombuffer(content, dtype="<f4").reshape(-1, columns).astype(np.float32)
