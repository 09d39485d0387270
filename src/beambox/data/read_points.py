"""Sweeps of any format: one function from a path to a frame.

**Intensity** becomes a share of the largest possible value, in [0, 1], by what the file holds:

* fractional numbers: nearly all at most 1: kept; all at most 255: divided by 255; at most 65535: by 65535; otherwise by
  the largest;
* whole numbers of 8 bits: divided by 255; wider ones: by 255 where none is larger, else by 65535, else by the largest.

"Nearly all" is all but one in a thousand, so that a few stray values do not darken a whole sweep; what lies outside
[0, 1] after scaling is clipped. ``intensity_scale`` replaces the rule by a factor (0.01 for percent) and clips nothing.
A file without intensity gets 0, and so does a point whose intensity is NaN. Whatever was decided stands in
:attr:`Frame.notes`. Every path takes this rule: training, evaluation and detection see the same numbers.

**Which column is the intensity** of a format that names its columns: the first of :data:`BRIGHTNESS` that is there, by
name without regard to case and to what CloudCompare puts before it; where ``fields`` names one of them, that one.

**Map coordinates** (UTM, say) do not fit into float32, which would leave steps of half a metre: the middle of such a
cloud becomes the origin of x and y before they are rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.formats.arrays import array_columns, read_npy, read_npz
from beambox.data.formats.binary import read_bin
from beambox.data.formats.brought import brought_reader, brought_suffixes
from beambox.data.formats.columns import Columns
from beambox.data.formats.las import read_las
from beambox.data.formats.pcd import read_pcd
from beambox.data.formats.ply import read_ply
from beambox.data.formats.recording import read_message, recording_of
from beambox.structures import Frame

__all__ = [
    "SUFFIXES",
    "frame_from_columns",
    "points_from_array",
    "read_frame",
    "read_points",
    "read_shifted",
    "readable_suffixes",
]

READERS: dict[str, Callable[[Path], Columns]] = {
    ".npy": read_npy,
    ".npz": read_npz,
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".las": read_las,
    ".laz": read_las,
}
SUFFIXES = (".bin", *READERS)
"""Endings of the files that can be read, without those that installed packages bring."""

STANDARD = ("x", "y", "z", "intensity")
POSITIONS = {
    axis: (axis, f"{axis}_m", f"pos_{axis}", f"position_{axis}", f"{axis}_pos", f"point_{axis}") for axis in "xyz"
}
BRIGHTNESS = (
    *("intensity", "intensities", "intens", "reflectivity", "reflectance", "remission", "remissions", "amplitude"),
    *("signal", "signal_photons", "backscatter", "echo_strength", "strength", "brightness", "refl", "int", "i", "r"),
)
"""Names of the column that says how much light came back, the likeliest first: those of ROS drivers (Velodyne, Ouster,
Hesai, Livox, RoboSense, Innoviz, SICK), of LAS and E57, of SemanticKITTI, PandaSet and Riegl."""
FARTHEST_MAP = 1e8
"""No map of the Earth has coordinates beyond this, metres."""
FAR = 10_000.0
"""Clouds whose middle lies farther away than this are probably not in the sensor's frame, metres."""


def read_frame(
    path: Path | str, *, fields: str | Sequence[str] | None = None, intensity_scale: float | None = None
) -> Frame:
    """Read a sweep: .bin, .npy, .npz, .pcd, .ply, .las or .laz.

    Points with NaN or infinite coordinates are dropped. An empty cloud is a frame without points.

    Args:
        path: the file; its ending tells the format. A sweep in a recording of ROS is RECORDING/TOPIC/NANOSECONDS.
        fields: names of columns, as a list or as "x,y,z,intensity,ring". For .bin and unnamed arrays: what each column
            of the file is, ``_`` for one to leave out; without it the first four are x, y, z, intensity. For formats
            that name their columns: which to take. Columns beyond x, y, z and intensity follow these, as ordered here.
        intensity_scale: a factor for intensity instead of the rule above.

    Returns:
        A frame named after the file, with ``(N, 4 or more)`` points and notes on what was decided.

    Raises:
        MissingFileError: if the file is not there.
        BeamboxError: if it cannot be read, or has no x, y, z.
    """
    path = Path(path)
    points, notes, _ = _read(path, fields, intensity_scale)
    return Frame(points, path.stem, notes=notes)


def read_shifted(
    path: Path | str, *, fields: str | Sequence[str] | None = None, intensity_scale: float | None = None
) -> tuple[Frame, tuple[float, float]]:
    """Read a sweep as :func:`read_frame`, and what was taken from x and y of map coordinates, metres."""
    path = Path(path)
    points, notes, shift = _read(path, fields, intensity_scale)
    return Frame(points, path.stem, notes=notes), shift


def read_points(
    path: Path | str, *, fields: str | Sequence[str] | None = None, intensity_scale: float | None = None
) -> Tensor:
    """Read only the points of a sweep, ``(N, 4 or more)`` float32; see :func:`read_frame`."""
    return _read(Path(path), fields, intensity_scale)[0]


def readable_suffixes() -> tuple[str, ...]:
    """Return the endings of the files that can be read, with those that installed packages bring."""
    return (*SUFFIXES, *(suffix for suffix in brought_suffixes() if suffix not in SUFFIXES))


def points_from_array(
    array: np.ndarray | Tensor, intensity_scale: float | None = None
) -> tuple[Tensor, tuple[str, ...]]:
    """Turn an array in memory into points by the same rules.

    Args:
        array: ``(N, 3 or more)`` x, y, z, intensity; columns beyond the fourth are left out.
        intensity_scale: a factor for intensity instead of the rule.

    Returns:
        ``(N, 4)`` float32 points and what was decided.
    """
    numbers = np.asarray(array.detach().cpu() if isinstance(array, Tensor) else array)
    return _assemble(array_columns(numbers, "the array of points"), "the array of points", None, intensity_scale)[:2]


def frame_from_columns(
    columns: Columns,
    where: str,
    *,
    fields: str | Sequence[str] | None = None,
    intensity_scale: float | None = None,
) -> Frame:
    """Turn columns that are in memory already, as of a message, into a frame; see :func:`read_frame`."""
    points, notes, _ = _assemble(columns, where, _field_names(fields), intensity_scale)
    return Frame(points, notes=notes)


Assembled = tuple[Tensor, tuple[str, ...], tuple[float, float]]  # points, notes, what was taken from x and y


def _read(path: Path, fields: str | Sequence[str] | None, scale: float | None) -> Assembled:
    names = _field_names(fields)
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return _assemble(_bin_columns(path, names), str(path), names, scale)
    reader = READERS.get(suffix) or brought_reader(suffix)
    if reader is None and recording_of(path) is not None:
        return _assemble(read_message(path), str(path), names, scale)
    if reader is None:
        hint = did_you_mean(suffix, readable_suffixes())
        raise BeamboxError(f'{path} has the ending "{suffix}", which no reader knows{hint}')
    columns = reader(path)
    if names is not None and suffix in (".npy", ".npz") and columns.names[4:5] in ((), ("column 5",)):
        if len(names) != len(columns.names):
            raise BeamboxError(f"{path} has {len(columns.names)} columns, but `fields` names {len(names)}: {names}")
        columns = Columns(names, columns.arrays)
    return _assemble(columns, str(path), names, scale)


def _field_names(fields: str | Sequence[str] | None) -> tuple[str, ...] | None:
    if fields is None:
        return None
    names = tuple(word.strip() for word in (fields.split(",") if isinstance(fields, str) else fields))
    named = [name for name in names if name != "_"]
    if not set("xyz") <= set(names) or len(set(named)) < len(named) or "" in names:
        raise BeamboxError(
            f'`fields` must name x, y and z, each name once, such as "x,y,z,intensity,ring"; got {names}'
        )
    return names


def _bin_columns(path: Path, names: tuple[str, ...] | None) -> Columns:
    points = read_bin(path, None if names is None else len(names))
    names = STANDARD if names is None else names
    return Columns(names, [points[:, k] for k in range(len(names))])


def _assemble(columns: Columns, where: str, fields: tuple[str, ...] | None, scale: float | None) -> Assembled:
    """Order the columns, drop points without a place, scale intensity."""
    place = {name: k for k, name in reversed(list(enumerate(columns.names)))}
    chosen, notes = _choose(columns.names, fields)
    lacking = [want for want in "xyz" if want not in chosen]
    if lacking:
        raise BeamboxError(
            f"{where} must have columns x, y and z; {' and '.join(lacking)} not found among "
            f"{', '.join(name[:60] for name in columns.names[:30]) or 'none'}"
        )
    taken = {columns.names[k] for k in chosen.values()}
    extra = [name for name in fields or () if name not in (*STANDARD, "_", *taken)]
    for name in extra:
        if name not in place:
            raise BeamboxError(f'{where} has no column "{name}"{did_you_mean(name, columns.names)}')
    notes = [*columns.notes, *notes]
    if fields is None and columns.names[4:5] == ("column 5",):
        notes.append(f"left out columns 5 to {len(columns.names)}: name them by `fields` to keep them")
    positions = [columns.arrays[chosen[want]] for want in "xyz"]
    shift = _map_origin(positions)
    points = np.zeros((len(columns), 4 + len(extra)), dtype=np.float32)
    for k, array in enumerate(positions):
        points[:, k] = _numbers(array - shift[k] if k < 2 and shift[k] else array)
    for k, name in enumerate(extra, start=4):
        points[:, k] = _known(_numbers(columns.arrays[place[name]]), name, notes)
    if "intensity" not in chosen:
        notes.append("no intensity in the file: filled with 0")
    else:
        bright, new_notes = _scaled_intensity(columns.arrays[chosen["intensity"]], scale)
        notes += new_notes
        points[:, 3] = _known(bright, "intensity", notes)
    finite = np.isfinite(points[:, :3]).all(axis=1)
    if not finite.all():
        notes.append(f"dropped {len(points) - int(finite.sum())} of {len(points)} points that are NaN or infinite")
        points = points[finite]
    notes += _far_away(points, shift, positions)
    return torch.from_numpy(points), tuple(notes), shift


def _choose(names: Sequence[str], fields: tuple[str, ...] | None) -> tuple[dict[str, int], list[str]]:
    """Find the columns that are x, y, z and intensity, and say where the choice was not plain."""
    place: dict[str, int] = {}
    for k, name in enumerate(names):
        place.setdefault(_plain(name), k)
    chosen = {
        axis: next(place[name] for name in aliases if name in place)
        for axis, aliases in POSITIONS.items()
        if any(name in place for name in aliases)
    }
    if {"g", "b"} <= place.keys():
        place.pop("r", None)  # red, not reflectance
    found = [name for name in BRIGHTNESS if name in place]
    asked = [name for name in map(_plain, fields or ()) if name in found]
    if asked:  # "x,y,z,reflectivity" asks for it; "x,y,z,intensity,reflectivity" has it as a fifth column
        chosen["intensity"] = place["intensity" if "intensity" in asked else asked[0]]
        return chosen, []
    if found:
        chosen["intensity"] = place[found[0]]
    others = [names[place[name]] for name in found[1:]]
    if not others or fields is not None:
        return chosen, []
    own = names[chosen["intensity"]]
    return chosen, [f"intensity is the column {own}; {', '.join(others)} is there too (--fields x,y,z,{others[0]})"]


def _plain(name: str) -> str:
    """Return a column's name in lower case, without what tools put before it (CloudCompare: "scalar_Intensity")."""
    plain = "_".join(name.lower().replace("(", " ").replace(")", " ").split())
    for start in ("scalar_field_", "scalar_", "vertex_", "point_"):
        if plain.startswith(start) and plain not in POSITIONS["x"] + POSITIONS["y"] + POSITIONS["z"]:
            return plain.removeprefix(start)
    return plain


def _known(values: np.ndarray, name: str, notes: list[str]) -> np.ndarray:
    """Replace what is not finite by 0: a point whose brightness is unknown is still a point."""
    unknown = ~np.isfinite(values)
    if unknown.any():
        notes.append(f"{int(unknown.sum())} of {len(values)} values of {name} are NaN or infinite: set to 0")
        values = np.where(unknown, np.float32(0), values)
    return values


def _map_origin(positions: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return what to take from x and y so that float32 can hold them: 0 unless they are exact map coordinates."""
    if any(array.dtype.itemsize < 8 or len(array) == 0 for array in positions[:2]):
        return 0.0, 0.0
    finite = np.isfinite(positions[0].astype(np.float64)) & np.isfinite(positions[1].astype(np.float64))
    if not finite.any():
        return 0.0, 0.0
    x, y = (float(np.median(array[finite].astype(np.float64))) for array in positions[:2])
    return (round(x), round(y)) if FAR < max(abs(x), abs(y)) < FARTHEST_MAP else (0.0, 0.0)


def _far_away(points: np.ndarray, shift: tuple[float, float], positions: Sequence[np.ndarray]) -> list[str]:
    if any(shift):
        return [
            f"map coordinates: {shift[0]:.0f} was taken from x and {shift[1]:.0f} from y, and boxes are relative to "
            "that point; detectors expect the sensor there"
        ]
    if not len(points) or float(np.abs(np.median(points[:, :2], axis=0)).max()) <= FAR:
        return []
    step = float(np.spacing(np.abs(points[:, :2]).max()))
    rounded = f" (as {positions[0].dtype} they are rounded to {step:.2g} m already)" if step > 0.01 else ""
    return [f"the points lie far from the origin, but detectors expect the sensor there: shift them first{rounded}"]


def _numbers(array: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes infinite, and is dropped
        return array.astype(np.float32)


def _scaled_intensity(array: np.ndarray, scale: float | None) -> tuple[np.ndarray, list[str]]:
    """Apply the rule at the top of this module; NaN stays NaN."""
    values = _numbers(array)
    usual = values[np.isfinite(values)]
    if len(usual) == 0:
        return values, []
    if scale is not None:
        if not (math.isfinite(scale) and scale > 0):
            raise BeamboxError(f"`intensity_scale` must be a positive number, got {scale}")
        notes = [] if scale == 1 else [f"intensity multiplied by {scale:g} as asked"]
        factor = np.float32(scale)
    else:
        top = _largest(array, usual)
        notes = [] if top == 1 else [f"intensity divided by {top:g}"]
        factor = np.float32(1 / top)
    values = values * factor
    with np.errstate(invalid="ignore"):
        outside = int(((values < 0) | (values > 1)).sum())
    if outside and scale is not None:
        notes.append(f"{outside} of {len(values)} intensities lie outside [0, 1]")
    elif outside:
        notes.append(f"clipped {outside} of {len(values)} intensities to [0, 1]")
        values = values.clip(0, 1)
    return values, notes


def _largest(array: np.ndarray, usual: np.ndarray) -> float:
    """Choose the value that stands for full intensity."""
    highest = float(usual.max())
    whole = array.dtype.kind in "iub"
    if whole and array.dtype.itemsize == 1:
        return 255.0
    if not whole and highest > 1:
        strays = len(usual) // 1000
        if float(np.partition(usual, len(usual) - 1 - strays)[len(usual) - 1 - strays]) <= 1:
            return 1.0
    if highest <= 1 and not whole:
        return 1.0
    return next((top for top in (255.0, 65535.0) if highest <= top), highest)
