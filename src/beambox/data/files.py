"""Small things every reader and writer of files needs."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, cast

from beambox.checks import BeamboxError, MissingFileError

__all__ = ["read_bytes", "read_text", "replacing", "write_bytes", "write_text"]


def read_bytes(path: Path, remedy: str = "") -> bytes:
    """Read a whole file.

    Args:
        path: the file.
        remedy: what to do where it is absent, appended to the message.

    Raises:
        MissingFileError: if it is not there.
        BeamboxError: if it is a folder or may not be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise MissingFileError(f"{path} is not there" + (f"; {remedy}" if remedy else "")) from None
    except OSError as error:
        raise BeamboxError(f"{path} cannot be read: {error.strerror or error}") from None


def read_text(path: Path, remedy: str = "") -> str:
    """Read a text file as UTF-8; see :func:`read_bytes`."""
    try:
        return read_bytes(path, remedy).decode("utf-8")
    except UnicodeDecodeError:
        raise BeamboxError(f"{path} must be a text file, but holds bytes that are not text") from None


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of ``path`` only once it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield cast(BinaryIO, stream)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes files that only their owner may read
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file; nothing half-written ever remains."""
    with replacing(path) as stream:
        stream.write(content)


def write_text(path: Path, content: str) -> None:
    """Write a whole text file, UTF-8 with newlines as given; see :func:`write_bytes`."""
    write_bytes(path, content.encode("utf-8"))
