"""The columns of a PointCloud2 message (ROS, sensor_msgs), however its header was filled in.

Drivers are known to write each field of the header wrongly somewhere. What is trusted is ``point_step``, ``width``,
``height`` and the length of the data; where they agree, ``row_step`` is not even looked at. What cannot be explained
is refused: points never vanish without a word.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns

__all__ = ["cloud_columns"]

NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Number types of columns by PointField's ``datatype``."""
FARTHEST = 1e6
"""Coordinates beyond this many metres mean that the bytes are in the other order."""


def cloud_columns(cloud: Any, where: str) -> Columns:
    """Take the columns out of a message.

    Args:
        cloud: with the attributes of sensor_msgs/PointCloud2.
        where: what to call it in messages.

    Raises:
        BeamboxError: naming the field of the header that cannot be what it says.
    """
    notes: list[str] = []
    data = np.ascontiguousarray(np.asarray(cloud.data, dtype=np.uint8).reshape(-1))
    fields = _fields(cloud, where, notes)
    extent = max((offset + np.dtype(kind).itemsize for _, offset, kind in fields), default=0)
    step = _point_step(cloud, len(data), extent, where, notes)
    records = _records(cloud, data, step, fields, where, notes)  # (N, step)
    arrays = [_column(records, offset, kind, bool(cloud.is_bigendian)) for _, offset, kind in fields]
    if len(records) and _garbled(fields, arrays):
        other = [_column(records, offset, kind, not cloud.is_bigendian) for _, offset, kind in fields]
        if not _garbled(fields, other):
            arrays = other
            notes.append(f"is_bigendian is {bool(cloud.is_bigendian)}, but the numbers are in the other order: read so")
    return Columns(tuple(name for name, _, _ in fields), arrays, tuple(notes))


def _fields(cloud: Any, where: str, notes: list[str]) -> list[tuple[str, int, str]]:
    """Return name, offset and number type of the fields that hold one number per point."""
    chosen: dict[str, tuple[str, int, str]] = {}
    offsets = sorted({int(field.offset) for field in cloud.fields})
    for field in cloud.fields:
        name = field.name.strip().strip("\0")
        position = name.lower() in ("x", "y", "z")
        if not name or name == "_":
            continue
        kind = NUMBERS.get(int(field.datatype))
        if kind is None:
            details = f"the field {name!a} has datatype {field.datatype}, which is no number type (1 to 8)"
            if position:
                raise BeamboxError(f"{where}: {details}")
            notes.append(f"{details}: left out")
            continue
        following = next((one for one in offsets if one > field.offset), None)
        end = int(field.offset) + np.dtype(kind).itemsize * int(field.count)
        several = field.count > 1 and end <= (following if following is not None else int(cloud.point_step))
        if several and not position:
            notes.append(f"the field {name!a} holds {field.count} numbers a point: left out")
            continue
        if name in chosen:
            notes.append(f"the field {name!a} stands there twice: took the first")
            continue
        chosen[name] = (name, int(field.offset), kind)
    places = [offset for name, offset, _ in chosen.values() if name.lower() in ("x", "y", "z")]
    if len(set(places)) < len(places):
        raise BeamboxError(f"{where}: x, y and z must lie at different offsets, got {places}")
    return list(chosen.values())


def _point_step(cloud: Any, size: int, extent: int, where: str, notes: list[str]) -> int:
    """Return the bytes from point to point."""
    step, count = int(cloud.point_step), max(1, int(cloud.height)) * max(1, int(cloud.width))
    if step >= max(1, extent):
        return step
    if size == 0:
        return max(1, extent)
    found, rest = divmod(size, count)
    if rest == 0 and max(1, extent) <= found < extent + 256:
        notes.append(f"point_step is {step}, less than its fields take ({extent}): took {found}, as the data have it")
        return found
    raise BeamboxError(f"{where}: point_step is {step} bytes, but its fields reach to byte {extent}")


def _records(
    cloud: Any, data: np.ndarray, step: int, place: list[tuple[str, int, str]], where: str, notes: list[str]
) -> np.ndarray:
    """Return the points as ``(N, step)`` bytes."""
    height, width, row, size = int(cloud.height), int(cloud.width), int(cloud.row_step), len(data)
    if height * width == 0 and size:
        filled = max(1, height) * max(1, width)
        if filled * step != size:
            raise BeamboxError(
                f"{where}: height {height} x width {width} means no point, but there are {size} bytes of data, room "
                f"for {size / step:g} points of {step} bytes"
            )
        notes.append(f"height is {height} and width {width}: took the {filled} points that the data hold")
        height, width = max(1, height), max(1, width)
    count = height * width
    if size == count * step:
        return data.reshape(count, step)
    fitting = [
        one for one in _row_lengths(height, width * step, row, size) if _plain(data, height, width, step, one, place)
    ]
    if len(fitting) == 1:
        if fitting[0] != row:
            notes.append(f"row_step is {row}, but the data have rows of {fitting[0]} bytes: read so")
        return _rows(data, height, width, step, fitting[0])
    if size < count * step:
        raise BeamboxError(
            f"{where} is cut short: height {height} x width {width} points of {step} bytes are {count * step} bytes, "
            f"{size} are there"
        )
    if height <= 1 and size - count * step < step:
        return data[: count * step].reshape(count, step)
    raise BeamboxError(
        f"{where}: height {height} x width {width} points of {step} bytes are {count * step} bytes, but {size} are "
        f"there, and row_step {row} does not explain them; the header is wrong, and points would be lost"
    )


def _row_lengths(height: int, filled: int, row: int, size: int) -> list[int]:
    """Return how long rows that end in padding may be: as row_step says, else as the length of the data allows."""
    if row > filled and size in (height * row, (height - 1) * row + filled):
        return [row]
    if height < 2:
        return []
    whole, rest = divmod(size, height)  # the last row may end in padding or not
    short, rest_of_short = divmod(size - filled, height - 1)
    return [one for one, left in ((whole, rest), (short, rest_of_short)) if left == 0 and one > filled]


def _rows(data: np.ndarray, height: int, width: int, step: int, row: int) -> np.ndarray:
    padded = np.zeros((height, row), np.uint8)
    padded.reshape(-1)[: len(data)] = data[: height * row]
    return padded[:, : width * step].reshape(height * width, step)


def _plain(data: np.ndarray, height: int, width: int, step: int, row: int, place: list[tuple[str, int, str]]) -> bool:
    """Tell whether rows of this length hold coordinates in each of them, and nothing in their padding."""
    padded = np.zeros((height, row), np.uint8)
    padded.reshape(-1)[: len(data)] = data[: height * row]
    if row - width * step >= step and padded[:, width * step :].any():
        return False  # points, not padding
    records = _rows(data, height, width, step, row)
    some = range(0, height, max(1, height // 50))
    rows = [records[k * width : (k + 1) * width] for k in some]
    return not any(_garbled(place, [_column(one, offset, kind, False) for _, offset, kind in place]) for one in rows)


def _column(records: np.ndarray, offset: int, kind: str, big: bool) -> np.ndarray:
    size = np.dtype(kind).itemsize
    exact = np.ascontiguousarray(records[:, offset : offset + size])
    return exact.view((">" if big else "<") + kind).reshape(-1)


def _garbled(fields: list[tuple[str, int, str]], arrays: list[np.ndarray]) -> bool:
    """Tell whether most coordinates are no metres: too large, or so small that they are bytes of something else."""
    for (name, _, kind), array in zip(fields, arrays):
        if name.lower() in ("x", "y", "z") and kind[0] == "f":
            size = np.abs(array[:: max(1, len(array) // 2000)].astype(np.float64))
            size = size[np.isfinite(size) & (size > 0)]
            if len(size) and float(((size > FARTHEST) | (size < 1e-20)).mean()) > 0.5:
                return True
    return False
