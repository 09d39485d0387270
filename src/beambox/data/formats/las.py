"""Survey files (.las, compressed .laz), through laspy."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode, library

__all__ = ["read_las"]

MINIMUM_HEADER = 227
RECORD_HEADER = 54
LARGEST_RATIO = 1000
"""A compressed file that claims to grow by more than this is damaged."""


def read_las(path: Path) -> Columns:
    """Read a LAS or LAZ file: x, y, z with the header's scale and offset applied, and every plain dimension.

    Raises:
        BeamboxError: if laspy is absent, or the file is damaged or cut short.
    """
    laspy = library("laspy", path)

    def read() -> Columns:
        with path.open("rb") as stream:
            _check_sizes(path, stream.read(path.stat().st_size))
        # the parallel decompressor ends the process where a damaged chunk table asks for too much memory
        cloud = laspy.read(str(path), laz_backend=laspy.LazBackend.Lazrs)
        names = ["x", "y", "z"]
        arrays = [np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)]
        for name in cloud.point_format.dimension_names:
            array = np.asarray(cloud[name])
            if name not in ("X", "Y", "Z") and array.ndim == 1 and array.dtype.kind in "fiu":
                names.append(name)
                arrays.append(array)
        return Columns(tuple(names), arrays)

    return decode(path, "LAS file", read)


def _check_sizes(path: Path, content: bytes) -> None:
    """Compare what the header promises with the file's size (ASPRS LAS 1.4, table 3).

    laspy trusts the header: wrong counts in a damaged file would keep it busy for hours, and wrong sizes in a
    compressed one end the whole process inside its decompressor.
    """
    if len(content) < MINIMUM_HEADER or content[:4] != b"LASF":
        raise BeamboxError(f"{path} is not a readable LAS file, or is damaged (it does not begin like one)")
    header_size, start, records, kind, length, count = struct.unpack_from("<HIIBHI", content, 94)
    if content[25] >= 4 and len(content) >= 255:
        count = max(count, struct.unpack_from("<Q", content, 247)[0])
    if not MINIMUM_HEADER <= header_size <= start <= len(content) or records * RECORD_HEADER > start - header_size:
        raise BeamboxError(f"{path} is not a readable LAS file, or is damaged (its header does not fit its size)")
    room = len(content) - start
    if kind < 64 and count * length > room:
        raise BeamboxError(
            f"{path} is cut short: its header promises {count} points of {length} bytes, it has room for "
            f"{room // max(1, length)}"
        )
    if kind >= 64 and count:
        _check_compressed(path, content, start, length, count)


def _check_compressed(path: Path, content: bytes, start: int, length: int, count: int) -> None:
    """Check the parts of a LAZ file that its decompressor takes on trust (LASzip's record and chunk table)."""
    damaged = BeamboxError(
        f"{path} is not a readable LAZ file, or is damaged (its compressed part does not fit its size)"
    )
    room = len(content) - start
    at = content.find(b"laszip encoded\0", 0, start)
    if at < 0 or room < 8 or count * length > LARGEST_RATIO * room:
        raise damaged
    body = (
        at - 2 + RECORD_HEADER
    )  # a record is: reserved (2), user id (16), record id (2), length (2), description (32)
    if body + 34 > start:
        raise damaged
    compressor, _coder, _major, _minor, _revision, _options, chunk = struct.unpack_from("<HHBBHII", content, body)
    (items,) = struct.unpack_from("<H", content, body + 32)
    if compressor not in (2, 3) or not 0 < items <= 16 or body + 34 + 6 * items > start or chunk == 0:
        raise damaged
    sizes = [struct.unpack_from("<HHH", content, body + 34 + 6 * k)[1] for k in range(items)]
    (table,) = struct.unpack_from("<q", content, start)
    if table == -1:
        (table,) = struct.unpack_from("<q", content, len(content) - 8)
    if sum(sizes) != length or not start + 8 <= table <= len(content) - 8:
        raise damaged
    version, chunks = struct.unpack_from("<II", content, table)
    if version != 0 or not 0 < chunks <= count:
        raise damaged
    if chunk != 0xFFFFFFFF and chunks != -(-count // chunk):
        raise damaged
