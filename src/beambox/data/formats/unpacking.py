"""Compressed parts of recordings, unpacked within bounds: a small file may otherwise ask for all memory or all disk."""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any, BinaryIO

from beambox.checks import BeamboxError

__all__ = ["bound_rosbags", "unpack"]

MOST = 512 << 20
"""Bytes of one unpacked chunk; recorders write chunks of 1 to 100 MB."""
RATIO, FREE = 1000, 16 << 20
"""A chunk holds at most RATIO times its packed size and FREE bytes more; point clouds shrink to a third, zeros to a
thousandth."""


def most_bytes(packed: int) -> int:
    """Return how much a packed part of this size may hold."""
    return min(MOST, RATIO * packed + FREE)


def unpack(data: bytes, new: Callable[[], Any]) -> bytes:
    """Unpack one chunk, which may be several frames in a row.

    Args:
        data: the packed bytes.
        new: makes a decompressor with ``decompress(data, max_length)``, ``eof`` and ``unused_data`` (bz2, lz4, zstd).

    Raises:
        BeamboxError: if it holds more than its size makes plausible, or ends too early.
    """
    most, parts, held = most_bytes(len(data)), [], 0
    while True:
        machine = new()
        part = machine.decompress(data, most + 1 - held)
        parts.append(part)
        held += len(part)
        if held > most:
            raise BeamboxError(f"a chunk of {len(data):,} packed bytes unpacks to more than {most:,}: refused")
        if not machine.eof:
            raise BeamboxError("a packed chunk ends too early")
        data = machine.unused_data or b""
        if not data:
            return b"".join(parts)


class _Bounded(io.RawIOBase):
    """A packed file opened for reading, that ends with an error where it holds too much."""

    def __init__(self, file: Any, most: int) -> None:
        self._file, self._left = file, most

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        part = self._file.read(min(size, 1 << 20) if size >= 0 else 1 << 20)
        self._left -= len(part)
        if self._left < 0:
            raise BeamboxError("a packed recording unpacks to more than its size makes plausible: refused")
        return part

    def close(self) -> None:
        self._file.close()
        super().close()


def bound_rosbags(reader1: ModuleType, reader2: ModuleType, mcap: ModuleType) -> None:
    """Have rosbags unpack within bounds: its tables of decompressors get ours.

    Args:
        reader1: ``rosbags.rosbag1.reader``.
        reader2: ``rosbags.rosbag2.reader``.
        mcap: ``rosbags.rosbag2.storage_mcap``.
    """
    if isinstance(reader2.zstd, SimpleNamespace):  # done before
        return
    import lz4.frame

    zstd = reader2.zstd

    def lz4_chunk(data: bytes, *_: object) -> bytes:
        return unpack(data, lz4.frame.LZ4FrameDecompressor)

    def zstd_chunk(data: bytes, *_: object) -> bytes:
        return unpack(data, zstd.ZstdDecompressor)

    def zstd_file(file: BinaryIO, mode: str) -> _Bounded:
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        return _Bounded(zstd.open(file, mode), RATIO * size + FREE)

    reader1.decompressors.update({"bz2": lambda data: unpack(data, bz2.BZ2Decompressor), "lz4": lz4_chunk})
    mcap.DECOMPRESSORS.update({"lz4": lz4_chunk, "zstd": zstd_chunk})
    reader2.zstd = SimpleNamespace(open=zstd_file, decompress=zstd_chunk)  # pyright: ignore[reportAttributeAccessIssue]
