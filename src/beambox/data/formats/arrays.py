"""NumPy's files: .npy with one array, .npz with several."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode

__all__ = ["array_columns", "read_npy", "read_npz"]

ORDER = ("x", "y", "z", "intensity")


def read_npy(path: Path) -> Columns:
    """Read one array: ``(N, 3 or more)`` numbers or records with named fields; pickled objects are refused."""
    return array_columns(decode(path, "NumPy file (.npy)", lambda: _load_npy(path)), str(path))


def read_npz(path: Path) -> Columns:
    """Read an archive: the array ``points``, or the only two-dimensional one, or arrays named x, y, z, ..."""
    return decode(path, "NumPy archive (.npz)", lambda: _load_npz(path))


def array_columns(array: np.ndarray, where: str) -> Columns:
    """Split an array into columns.

    Args:
        array: ``(N, 3 or more)`` numbers: x, y, z, intensity, then unnamed columns; or ``(N,)`` named records.
        where: what to call it in messages.
    """
    if array.dtype.names:
        flat = array.reshape(-1)
        return Columns(tuple(array.dtype.names), [flat[name] for name in array.dtype.names])
    if array.dtype.kind not in "fiub":
        raise BeamboxError(f"{where} must hold real numbers, got an array of {array.dtype}")
    if array.ndim != 2 or array.shape[1] < 3:
        hint = "; transpose it" if array.ndim == 2 and array.shape[0] in (3, 4, 5, 6) else ""
        raise BeamboxError(f"{where} must hold an array of shape (N, 3 or more), got {array.shape}{hint}")
    if array.shape[1] > 64:
        raise BeamboxError(f"{where} must hold one point a row, got an array of shape {array.shape}; is it transposed?")
    names = ORDER + tuple(f"column {number}" for number in range(5, array.shape[1] + 1))
    return Columns(names[: array.shape[1]], [array[:, k] for k in range(array.shape[1])])


def _load_npy(path: Path) -> np.ndarray:
    with path.open("rb") as stream:
        if stream.read(6) != b"\x93NUMPY":
            raise ValueError("it does not begin like one")
    return np.load(path, allow_pickle=False)


def _load_npz(path: Path) -> Columns:
    with path.open("rb") as stream:
        if stream.read(4) not in (b"PK\x03\x04", b"PK\x05\x06"):
            raise ValueError("it does not begin like one")
    with np.load(path, allow_pickle=False) as archive:
        names = list(archive.files)
        if {"x", "y", "z"} <= set(names):
            arrays = [archive[name] for name in names]
            length = len(np.atleast_1d(archive["x"]))
            kept = [(name, array) for name, array in zip(names, arrays) if array.shape == (length,)]
            if not {"x", "y", "z"} <= {name for name, _ in kept}:
                raise BeamboxError(f"{path} must hold x, y and z of one length")
            return Columns(tuple(name for name, _ in kept), [array for _, array in kept])
        if "points" not in names:
            flat = [name for name in names if archive[name].ndim == 2]
            if len(flat) != 1:
                raise BeamboxError(
                    f"{path} must hold an array named `points`, or one two-dimensional array, or x, y and z; "
                    f"got {', '.join(names) or 'nothing'}"
                )
            names = flat
        name = "points" if "points" in names else names[0]
        return array_columns(archive[name], f"{path}, array `{name}`")
