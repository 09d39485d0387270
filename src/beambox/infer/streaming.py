"""From anything that names sweeps to frames, one at a time: lists, folders, patterns, recordings, generators."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.data.formats.recording import recording_of
from beambox.infer.inputs import Sweep, find_sweeps
from beambox.structures import Frame

__all__ = ["Input", "each_input", "groups", "names_one_sweep"]

Input = str | Path | np.ndarray | Tensor | Frame
"""One sweep, or what names several: a folder, a pattern, a recording."""


def names_one_sweep(given: object) -> bool:
    """Whether an input is one sweep; a folder, a pattern, a recording and any iterable stand for several."""
    if isinstance(given, np.ndarray | Tensor | Frame | Sweep):
        return True
    if not isinstance(given, str | Path):
        return False
    path = Path(given)
    root = recording_of(path)
    if root is None:  # a name that is not there is one sweep, whose reading says so
        return path.is_file() or not (path.is_dir() or glob.has_magic(str(given)))
    return path not in (root, root.parent) and path.name[:1].isdigit() and path.parent != root


def each_input(given: Input | Sweep | Iterable[Input | Sweep]) -> Iterator[Input | Sweep]:
    """Yield one sweep after the other; what an iterable holds may stand for several too.

    Raises:
        BeamboxError: if something is no input; MissingFileError if a path names nothing.
    """
    if isinstance(given, str | Path):
        yield from find_sweeps([given])
    elif isinstance(given, np.ndarray | Tensor | Frame | Sweep):
        yield given
    elif isinstance(given, Iterable) and not isinstance(given, bytes | dict):
        for one in given:
            yield from each_input(one)
    else:
        raise BeamboxError(
            "a detector takes a path, an (N, 4) array or tensor, a Frame, or a list, folder, pattern, recording or "
            f"generator of these; got {type(given).__name__}"
        )


def groups(given: Iterable[Input | Sweep], read: Callable[[Input | Sweep], Frame], size: int) -> Iterator[list[Frame]]:
    """Read inputs as they come and yield lists of ``size`` frames, the last one perhaps shorter."""
    pending: list[Frame] = []
    for one in given:
        pending.append(read(one))
        if len(pending) == size:
            yield pending
            pending = []
    if pending:
        yield pending
