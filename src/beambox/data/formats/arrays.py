"""NumPy's files: .npy with one array, .npz with several; each header is compared with the file before room is made."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode

__all__ = ["ORDER", "array_columns", "load_archive", "read_npy", "read_npz"]

ORDER = ("x", "y", "z", "intensity")
POSITIONS = ("points", "xyz", "position", "positions", "pos", "coordinates", "coords", "coord", "cloud", "pointcloud")
"""Names under which tools store an array of positions."""
LARGEST_RATIO, ALWAYS_ALLOWED = 200, 64 << 20
"""A compressed archive may grow by this factor, or to this many bytes whatever its size."""
MOST_ARRAYS = 1000


def read_npy(path: Path) -> Columns:
    """Read one array: ``(N, 3 or more)`` numbers or records with named fields; pickled objects are refused."""

    def load() -> np.ndarray:
        size = path.stat().st_size
        with path.open("rb") as stream:
            return _load_array(stream, size)

    return array_columns(decode(path, "NumPy file (.npy)", load), str(path))


def read_npz(path: Path) -> Columns:
    """Read an archive: arrays named x, y, z, ...; or one of positions, and further ones as long, such as intensity."""
    return _archive_columns(load_archive(path), path)


def load_archive(path: Path, kind: str = "NumPy archive (.npz)") -> dict[str, np.ndarray]:
    """Read all arrays of an archive, by name.

    Raises:
        MissingFileError: if it is not there.
        BeamboxError: if it is damaged, holds pickled objects, or would grow out of proportion to its size.
    """

    def load() -> dict[str, np.ndarray]:
        with path.open("rb") as stream:
            if stream.read(4) not in (b"PK\x03\x04", b"PK\x05\x06"):
                raise ValueError("it does not begin like one")
        with zipfile.ZipFile(path) as archive:
            entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
            grown = sum(entry.file_size for entry in entries)
            if grown > max(ALWAYS_ALLOWED, LARGEST_RATIO * path.stat().st_size) or len(entries) > MOST_ARRAYS:
                raise ValueError(f"it claims to grow to {grown / 1e6:.0f} MB in {len(entries)} arrays")
            found = {}
            for entry in entries:
                with archive.open(entry) as stream:
                    found[entry.filename.removesuffix(".npy")] = _load_array(io.BytesIO(stream.read()), entry.file_size)
            return found

    return decode(path, kind, load)


def _load_array(stream: BinaryIO, size: int) -> np.ndarray:
    """Read one array; numpy would make room for whatever the header claims."""
    if stream.read(6) != b"\x93NUMPY":
        raise ValueError("it does not begin like one")
    stream.seek(0)
    version = np.lib.format.read_magic(stream)  # pyright: ignore[reportArgumentType]
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = reader(stream)  # pyright: ignore[reportArgumentType]
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which could run code")
    if dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize > size - stream.tell():
        raise ValueError(f"its header promises {math.prod(shape)} values of {dtype.itemsize} bytes, more than it holds")
    stream.seek(0)
    return np.load(stream, allow_pickle=False)


def array_columns(array: np.ndarray, where: str) -> Columns:
    """Split an array into columns.

    Args:
        array: ``(N, 3 or more)`` numbers: x, y, z, intensity, then unnamed columns; or ``(N,)`` named records.
        where: what to call it in messages.
    """
    if array.dtype.names:
        return _record_columns(array.reshape(-1), where)
    if array.dtype.kind not in "fiub":
        raise BeamboxError(f"{where} must hold real numbers, got an array of {array.dtype}")
    if array.ndim != 2 or array.shape[1] < 3:
        hint = "; transpose it" if array.ndim == 2 and array.shape[0] in (3, 4, 5, 6) else ""
        raise BeamboxError(f"{where} must hold an array of shape (N, 3 or more), got {array.shape}{hint}")
    if array.shape[1] > 64:
        raise BeamboxError(
            f"{where} must hold one point per row, got an array of shape {array.shape}; is it transposed?"
        )
    names = ORDER + tuple(f"column {number}" for number in range(5, array.shape[1] + 1))
    return Columns(names[: array.shape[1]], [array[:, k] for k in range(array.shape[1])])


def _record_columns(array: np.ndarray, where: str) -> Columns:
    """Take the columns of named records; records within records are opened, positions of three numbers parted."""
    names: list[str] = []
    arrays: list[np.ndarray] = []
    left_out: list[str] = []

    def take(name: str, values: np.ndarray) -> None:
        if values.dtype.names:
            for inner in values.dtype.names:
                take(inner, values[inner])
        elif values.dtype.kind not in "fiub" or (values.ndim > 1 and not _holds_positions(name, values)):
            left_out.append(f"{name} ({values.dtype}{'' if values.ndim == 1 else f' {values.shape[1:]}'})")
        elif values.ndim == 2:
            for k, letter in enumerate(ORDER[: values.shape[1]]):
                names.append(letter)
                arrays.append(values[:, k])
        else:
            names.append(name)
            arrays.append(values)

    for name in array.dtype.names or ():
        take(name, array[name])
    if not arrays:
        raise BeamboxError(f"{where} must hold columns of real numbers, got {', '.join(left_out)}")
    notes = (f"left out what is not one real number per point: {', '.join(left_out)}",) if left_out else ()
    return Columns(tuple(names), arrays, notes)


def _holds_positions(name: str, values: np.ndarray) -> bool:
    return values.ndim == 2 and values.shape[1] in (3, 4) and name.lower() in POSITIONS


def _archive_columns(arrays: Mapping[str, np.ndarray], path: Path) -> Columns:
    names = list(arrays)
    if {"x", "y", "z"} <= {name.lower() for name in names}:
        length = next(len(np.atleast_1d(arrays[name])) for name in names if name.lower() == "x")
        kept = [name for name in names if arrays[name].shape == (length,) and arrays[name].dtype.kind in "fiub"]
        if not {"x", "y", "z"} <= {name.lower() for name in kept}:
            raise BeamboxError(f"{path} must hold x, y and z of one length")
        return Columns(tuple(kept), [arrays[name] for name in kept])
    wide = [name for name in names if arrays[name].ndim == 2]
    chosen = [name for wanted in POSITIONS for name in names if name.lower() == wanted] or wide
    if len(chosen) != 1 and not (chosen and chosen[0].lower() in POSITIONS):
        raise BeamboxError(
            f"{path} must hold an array named `points`, or one two-dimensional array, or x, y and z; "
            f"got {', '.join(names) or 'nothing'}"
        )
    main = array_columns(arrays[chosen[0]], f"{path}, array `{chosen[0]}`")
    beside = {
        name: array.reshape(-1)
        for name, array in arrays.items()
        if name != chosen[0] and array.shape in ((len(main),), (len(main), 1)) and array.dtype.kind in "fiub"
    }
    if arrays[chosen[0]].dtype.names or not beside:
        return main
    # an array's fourth column has no name of its own; one that says what it is goes first
    brightness = any(name.lower().startswith(("intens", "reflect", "remission")) for name in beside)
    kept = 3 if brightness else len(main.names)
    notes = ("the fourth column of the array gave way to the array of that name",) if kept < len(main.names) else ()
    return Columns((*main.names[:kept], *beside), [*main.arrays[:kept], *beside.values()], (*main.notes, *notes))
