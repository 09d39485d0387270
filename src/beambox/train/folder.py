"""The folder of a run: one training at a time writes into it, and one older checkpoint stays beside the last."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beambox.checks import BeamboxError

__all__ = ["BEST", "FINAL", "LAST", "OBJECTS", "PREVIOUS", "keep_older", "locked"]

LAST, PREVIOUS = "last.safetensors", "previous.safetensors"
BEST, FINAL, OBJECTS = "best.safetensors", "final.safetensors", "objects.npz"
LOCK = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the operating system lets it go however the process ends.

    Raises:
        BeamboxError: if another process holds it, or it cannot be written.
    """
    path = folder / LOCK
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise BeamboxError(f"cannot write into {folder}: {error.strerror or error}; give another --out") from None
    try:
        try:
            _lock(handle)
        except OSError:
            owner = os.pread(handle, 20, 0).decode("ascii", "replace") if hasattr(os, "pread") else ""
            by = f" (process {owner})" if owner.isdigit() else ""
            raise BeamboxError(
                f"another training writes into {folder}{by}; wait for its end, or give another --out"
            ) from None
        os.truncate(handle, 0)
        os.write(handle, str(os.getpid()).encode())
        yield
    finally:
        os.close(handle)


def _lock(handle: int) -> None:
    """Lock an open file, or raise OSError where another process has it."""
    if os.name == "nt":
        import msvcrt

        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]
        return
    import fcntl

    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def keep_older(folder: Path) -> Iterator[None]:
    """Let the present checkpoint stay as the previous one, once another has taken its place without an exception."""
    last, draft = folder / LAST, folder / f".{PREVIOUS}.part"
    kept = False
    with suppress(OSError):  # where there is none, or no room for a second one
        draft.unlink(missing_ok=True)
        try:
            os.link(last, draft)
        except OSError:  # a file system without links
            shutil.copyfile(last, draft)
        kept = True
    try:
        yield
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    if kept:
        draft.replace(folder / PREVIOUS)
