"""The recording that was read last stays open: opening one costs a thousand times what one of its sweeps does."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

__all__ = ["close_kept", "kept_open"]


class _Kept(threading.local):
    """One reader for each thread, as readers move about in their file."""

    key: tuple[object, ...] | None = None
    reader: Any = None


_kept = _Kept()


@contextmanager
def kept_open(root: Path, make: Callable[[Path], Any]) -> Iterator[Any]:
    """Give an open reader of a recording: the one that is open where the recording and the process are the same.

    Args:
        root: the file or folder.
        make: makes a reader that has ``open`` and ``close``.
    """
    key = (os.getpid(), *_state(root))
    if _kept.key != key:
        close_kept()
        reader = make(root)
        reader.open()
        _kept.key, _kept.reader = key, reader
    try:
        yield _kept.reader
    except BaseException:
        close_kept()
        raise


def close_kept() -> None:
    """Close the reader that this thread has open, if any; its file may then be moved everywhere."""
    reader, key = _kept.reader, _kept.key
    _kept.key = _kept.reader = None
    if reader is not None and key is not None and key[0] == os.getpid():  # a forked copy belongs to the parent
        with suppress(Exception):
            reader.close()


def _state(root: Path) -> Iterator[object]:
    """Yield what changes where a recording is written anew; what SQLite lays beside its file does not count."""
    yield root.resolve()
    for path in sorted(root.iterdir()) if root.is_dir() else [root]:
        if path.suffix.lower() in (".bag", ".mcap", ".db3", ".yaml"):
            status = path.stat()
            yield from (path.name, status.st_size, status.st_mtime_ns, status.st_ino)
