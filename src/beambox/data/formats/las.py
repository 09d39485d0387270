"""Survey files (.las, compressed .laz), through laspy."""

from __future__ import annotations

import importlib
import io
import struct
from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode, library
from beambox.io import read_bytes

__all__ = ["read_las"]

MINIMUM_HEADER = 227
RECORD_HEADER = 54
LONG_RECORD_HEADER = 60
LARGEST_RATIO = 1000
"""A compressed file that claims to grow by more than this is damaged."""
ITEMS = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
"""Kind of a compressed item -> its bytes; kinds 0 and 14 are extra bytes of any number (LASzip)."""
EXTRA = (0, 14)
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Kind of an item of LAS 1.4 -> parts that are compressed apart; extra bytes have one each."""
LAYERED = 3  # the compressor of LAS 1.4's point formats
VARIABLE = 0xFFFFFFFF  # chunks of different numbers of points


def read_las(path: Path) -> Columns:
    """Read a LAS or LAZ file: x, y, z with the header's scale and offset applied, and every plain dimension.

    Raises:
        BeamboxError: if laspy is absent, or the file is damaged or cut short.
    """
    laspy = library("laspy", path)

    def read() -> Columns:
        _check_sizes(path, read_bytes(path))
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
    _check_records(path, content, header_size, start, records)
    if kind < 64 and count * length > room:
        raise BeamboxError(
            f"{path} is cut short: its header promises {count} points of {length} bytes, it has room for "
            f"{room // max(1, length)}"
        )
    if kind >= 64 and count:
        _check_compressed(path, content, start, length, count)


def _check_records(path: Path, content: bytes, header_size: int, start: int, records: int) -> None:
    """Walk through the records before and, since LAS 1.4, behind the points."""
    at, long_records = header_size, 0
    for _ in range(records):
        at += RECORD_HEADER + (struct.unpack_from("<H", content, at + 20)[0] if at + RECORD_HEADER <= start else start)
        if at > start:
            raise BeamboxError(f"{path} is not a readable LAS file, or is damaged (a record does not fit its header)")
    if content[25] >= 4 and header_size >= 255:
        at, long_records = struct.unpack_from("<QI", content, 235)
    if long_records and long_records * LONG_RECORD_HEADER > max(0, len(content) - at):
        raise BeamboxError(
            f"{path} is cut short, or is damaged: its header promises {long_records} extended records behind the points"
        )
    for _ in range(long_records):
        size = (
            struct.unpack_from("<Q", content, at + 20)[0] if at + LONG_RECORD_HEADER <= len(content) else len(content)
        )
        at += LONG_RECORD_HEADER + size
        if at > len(content):
            raise BeamboxError(f"{path} is cut short, or is damaged: an extended record does not fit into the file")


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
    parts = [struct.unpack_from("<HHH", content, body + 34 + 6 * k)[:2] for k in range(items)]
    if any(size == 0 or (kind not in EXTRA and ITEMS.get(kind) != size) for kind, size in parts):
        raise damaged
    (table,) = struct.unpack_from("<q", content, start)
    if table == -1:
        (table,) = struct.unpack_from("<q", content, len(content) - 8)
    if sum(size for _, size in parts) != length or not start + 8 <= table <= len(content) - 8:
        raise damaged
    version, chunks = struct.unpack_from("<II", content, table)
    if version != 0 or not 0 < chunks <= count:
        raise damaged
    if chunk != VARIABLE and chunks != -(-count // chunk):
        raise damaged
    (described,) = struct.unpack_from("<H", content, at + 18)
    if not _chunks_fit(content, content[body : body + described], start, table, count, parts, compressor == LAYERED):
        raise damaged


def _chunks_fit(
    content: bytes, record: bytes, start: int, table: int, count: int, parts: list[tuple[int, int]], layered: bool
) -> bool:
    """Tell whether the chunks fill the compressed part, and the layers of each its chunk."""
    lazrs = importlib.import_module("lazrs")
    stream = io.BytesIO(content)
    stream.seek(start)
    chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(record))
    if sum(size for _, size in chunks) != table - start - 8:
        return False
    if not layered:
        return True
    layers = sum(LAYERS.get(kind, size) for kind, size in parts)
    first = sum(size for _, size in parts)  # the first point stands uncompressed
    at, left = start + 8, count
    for promised, size in chunks:
        if size < first + 4 + 4 * layers:
            return False
        (points,) = struct.unpack_from("<I", content, at + first)
        sizes = struct.unpack_from(f"<{layers}I", content, at + first + 4)
        if points != min(promised, left) or first + 4 + 4 * layers + sum(sizes) != size:
            return False
        at, left = at + size, left - points
    return left == 0
