"""From the bytes of a request to a frame, by the readers of files.

The bytes go into a file that the service names, in a folder of its own, and the file is removed once it is read: what
a request says never becomes part of a path.
"""

from __future__ import annotations

import io
import itertools
import re
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

from beambox.checks import BeamboxError
from beambox.data.read_points import SUFFIXES, read_frame
from beambox.io import write_bytes
from beambox.serve.limits import RequestError, ServeLimits
from beambox.structures import Frame

__all__ = ["CONTENT_TYPES", "FORMATS", "choose_format", "read_body"]

FORMATS = tuple(suffix[1:] for suffix in SUFFIXES)
"""Values of the query's ``format``."""
CONTENT_TYPES = {
    "application/x-npy": "npy",
    "application/x-npz": "npz",
    "application/x-pcd": "pcd",
    "application/x-ply": "ply",
    "model/ply": "ply",
    "application/vnd.las": "las",
    "application/vnd.laszip": "laz",
}
"""Content type -> format."""
ANY_BYTES = ("", "application/octet-stream", "application/x-www-form-urlencoded", "binary/octet-stream")
"""Content types that say nothing of the format; curl's --data-binary sends the third."""
BEGINNINGS = {b"\x93NUMPY": "npy", b"PK\x03\x04": "npz", b"ply": "ply", b"# .PCD": "pcd", b"VERSION": "pcd"}
"""How the formats begin that can be told by that; LAS and LAZ are told apart by a bit of their header."""
LAS_HEADER = 227
_numbers = itertools.count()


def choose_format(asked: str, content_type: str, content: bytes) -> str:
    """Choose the format of a body: what the query asks for, else the content type, else how the body begins.

    Args:
        asked: the query's ``format``; empty for none.
        content_type: the header's value without parameters.
        content: the body.

    Raises:
        RequestError: 415 for a format or a content type that is not known.
    """
    if asked:
        if asked.lower() not in FORMATS:
            raise RequestError(415, f"`format` must be one of {', '.join(FORMATS)}, got {asked[:40]!a}")
        return asked.lower()
    kind = content_type.strip().lower()
    if kind in CONTENT_TYPES:
        return CONTENT_TYPES[kind]
    if kind not in ANY_BYTES:
        raise RequestError(
            415,
            f"expected the bytes of a sweep as application/octet-stream or {', '.join(CONTENT_TYPES)}, "
            f"got {kind[:60]!a}; name the format in the query, as ?format=pcd",
        )
    if content[:4] == b"LASF" and len(content) > LAS_HEADER:
        return "laz" if content[104] & 0x80 else "las"
    return next((name for start, name in BEGINNINGS.items() if content.startswith(start)), "bin")


def read_body(
    content: bytes, kind: str, folder: Path, limits: ServeLimits, fields: str | None, intensity_scale: float | None
) -> Frame:
    """Read a body as a file of its format; see :func:`beambox.data.read_points.read_frame`.

    Args:
        content: the body.
        kind: of :data:`FORMATS`.
        folder: of the service, for the file.
        limits: of points and of what compressed bytes grow to.
        fields: names of the columns; None for the format's own.
        intensity_scale: factor that brings the intensity to [0, 1]; None finds it.

    Raises:
        RequestError: 413 for too many points or bytes, 400 for what is no sweep.
    """
    if not content:
        raise RequestError(400, "the body is empty; expected the bytes of a sweep, as curl --data-binary @scan.bin")
    grown = unpacked_size(content, kind)
    if grown > limits.max_unpacked:
        raise RequestError(
            413, f"the body would unpack to {grown / 1e6:.0f} MB, allowed {limits.max_unpacked / 1e6:.0f} MB"
        )
    path = folder / f"body-{next(_numbers)}.{kind}"
    try:
        write_bytes(path, content)
        frame = read_frame(path, fields=fields, intensity_scale=intensity_scale)
    except BeamboxError as error:
        message = str(error).replace(str(path), "the body").replace(path.name, "the body")
        raise RequestError(400, message) from error
    finally:
        path.unlink(missing_ok=True)
    if len(frame) > limits.max_points:
        raise RequestError(413, f"the sweep has {len(frame):,} points, allowed {limits.max_points:,}")
    return replace(frame, id="")


def unpacked_size(content: bytes, kind: str) -> int:
    """Return the bytes that a body says it becomes, 0 where it is not compressed or says nothing sensible."""
    try:
        if kind == "npz":
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                return sum(entry.file_size for entry in archive.infolist())
        if kind in ("las", "laz") and len(content) > LAS_HEADER:
            length, count = struct.unpack_from("<HI", content, 105)
            if content[25] >= 4 and len(content) >= 255:
                count = max(count, *struct.unpack_from("<Q", content, 247))
            return length * count
        if kind == "pcd":
            data = re.search(rb"(?mi)^DATA[ \t]+binary\S*compressed\s*?\n", content[: 64 << 10])
            return struct.unpack_from("<I", content, data.end() + 4)[0] if data else 0
    except (zipfile.BadZipFile, struct.error, OSError, ValueError, NotImplementedError):
        return 0  # the reader says what is wrong with it
    return 0
