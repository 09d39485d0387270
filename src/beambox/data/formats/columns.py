"""What every format's reader returns: named columns of equal length, each in the type the file has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import numpy as np

from beambox.checks import BeamboxError, MissingFileError, import_library

__all__ = ["Columns", "decode", "library"]

T = TypeVar("T")


@dataclass(frozen=True)
class Columns:
    """Named columns of a point cloud as a file stores them."""

    names: tuple[str, ...]
    """Name of each column; unnamed ones are called ``column 5`` and so on, counted from 1."""
    arrays: Sequence[np.ndarray]
    """``(N,)`` each, of the file's own number type."""
    notes: tuple[str, ...] = ()
    """What the reader had to decide."""

    def __len__(self) -> int:
        return len(self.arrays[0]) if self.arrays else 0


def library(name: str, path: Path, extra: str = "formats") -> ModuleType:
    """Import an optional library that reads a format; see :func:`beambox.checks.import_library`."""
    what = f"reading {path.suffix or 'such'} files ({path.name})"
    return import_library(name, extra, what, "or convert the file to .npy")


def decode(path: Path, kind: str, read: Callable[[], T]) -> T:
    """Run a library's reader on a file and turn whatever it raises for bad content into one clear error.

    Args:
        path: the file, for the messages.
        kind: what the content should be, such as "PCD file".
        read: does the work.
    """
    if path.is_dir():
        raise BeamboxError(f"{path} must be a {kind}, but is a folder")
    if not path.exists():
        raise MissingFileError(f"{path} is not there")
    try:
        return read()
    except BeamboxError:
        raise
    except OSError as error:
        raise BeamboxError(f"{path} cannot be read: {error.strerror or error}") from None
    except Exception as error:  # the libraries raise nearly anything where the content is broken
        reason = " ".join(str(error).split())[:160]
        details = f"{type(error).__name__}: {reason}" if reason else type(error).__name__
        raise BeamboxError(f"{path} is not a readable {kind}, or is damaged ({details})") from error
