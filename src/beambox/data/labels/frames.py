"""What every label format is read into and written from, and the checks that all share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError
from beambox.geometry.angles import wrap

__all__ = ["LabeledFrame", "Reader", "member", "vector"]

Floats = NDArray[np.float64]
TILT = 0.02
"""Radians from which a box that leans is mentioned."""
FARTHEST = 1e9


@dataclass(frozen=True)
class LabeledFrame:
    """The boxes of one frame; N boxes."""

    names: tuple[str, ...]
    """Class of each, as written."""
    boxes: Floats
    """``(N, 7)`` x, y, z (center), l, w, h, yaw in the file's axes; metres, radians counter-clockwise from +x."""
    ids: tuple[str, ...] = ()
    """Identity of each, or empty where the format has none."""
    places: tuple[str, ...] = ()
    """Where each stands in the file, for messages."""

    def __len__(self) -> int:
        return len(self.names)

    def identities(self) -> tuple[str, ...]:
        """Return the identity of each box; its position, from 1, where there is none."""
        return tuple(given or str(k) for k, given in enumerate(self.ids or ("",) * len(self), start=1))


@dataclass
class Reader:
    """Collects the boxes of one file, checks them and keeps notes."""

    where: str
    """What messages call the file."""
    degrees: bool = False
    """Whether angles are degrees."""
    notes: list[str] = field(default_factory=list)
    _rows: dict[str, list[tuple[str, list[float], str, str]]] = field(default_factory=dict)
    _tilt: float = 0.0
    _angles: list[float] = field(default_factory=list)

    def frame(self, name: str) -> None:
        """Make a frame known, which may have no box."""
        self._rows.setdefault(name, [])

    def add(self, frame: str, name: object, numbers: Sequence[Any], place: str, identity: object = "") -> None:
        """Add a box: x, y, z, l, w, h, yaw.

        Raises:
            BeamboxError: if a number is none or not finite, a size is negative, or the class has no name.
        """
        place = f"{self.where}, {place}"
        if not isinstance(name, str) or not name.strip():
            raise BeamboxError(f"{place}: the class must be a name, got {name!r:.40}")
        try:
            values = [float(number) for number in numbers]
        except (TypeError, ValueError):
            raise BeamboxError(f"{place}: expected numbers x y z l w h yaw, got {list(numbers)!s:.120}") from None
        if not all(math.isfinite(one) and abs(one) < FARTHEST for one in values) or min(values[3:6]) < 0:
            raise BeamboxError(f"{place}: expected finite metres and sizes of at least 0, got {values}")
        if self.degrees:
            values[6] = math.radians(values[6])
        self._angles.append(values[6])
        values[6] = wrap(values[6])
        known = "" if identity is None else str(identity)
        self._rows.setdefault(frame, []).append((name.strip(), values, known, place))

    def lean(self, *angles: float) -> None:
        """Take note of roll and pitch, radians (degrees where the file has those): boxes here stand upright."""
        most = max((abs(wrap(math.radians(a) if self.degrees else a)) for a in angles), default=0.0)
        self._tilt = max(self._tilt, min(most, abs(math.pi - most)))

    def result(self) -> dict[str, LabeledFrame]:
        """Return the frames.

        Raises:
            BeamboxError: if angles that should be radians are degrees.
        """
        turned = max((abs(angle) for angle in self._angles), default=0.0)
        if not self.degrees and turned > 4 * math.pi:
            raise BeamboxError(
                f"{self.where}: angles should be radians, but reach {turned:g}: they are degrees; say so (--degrees)"
            )
        if self.degrees and len(self._angles) >= 3 and 0 < math.degrees(turned) <= 2 * math.pi:
            self.notes.append(f"{self.where}: angles reach only {math.degrees(turned):.2f} degrees: are they radians?")
        if self._tilt > TILT:
            self.notes.append(
                f"{self.where}: boxes lean by up to {math.degrees(self._tilt):.1f} degrees; they are taken as upright"
            )
        return {frame: self._frame(rows) for frame, rows in self._rows.items()}

    @staticmethod
    def _frame(rows: Iterable[tuple[str, list[float], str, str]]) -> LabeledFrame:
        rows = list(rows)
        ids = tuple(identity for _, _, identity, _ in rows)
        return LabeledFrame(
            tuple(name for name, _, _, _ in rows),
            np.array([values for _, values, _, _ in rows], dtype=np.float64).reshape(-1, 7),
            ids if any(ids) else (),
            tuple(place for _, _, _, place in rows),
        )


def member(value: Any, key: str, kind: type | tuple[type, ...], where: str) -> Any:
    """Return an entry of a JSON object.

    Raises:
        BeamboxError: if there is none, or it is not of the kind.
    """
    found = value.get(key) if isinstance(value, Mapping) else None
    if not isinstance(found, kind) or isinstance(found, bool):
        type_names = {dict: "an object", list: "a list", str: "a text", float: "a number"}
        first = kind[0] if isinstance(kind, tuple) else kind
        raise BeamboxError(
            f"{where}: expected {type_names.get(first, 'a value')} under the key `{key}`, got {found!r:.60}"
        )
    return found


def vector(value: Any, key: str, where: str, axes: Sequence[str] = ("x", "y", "z")) -> list[Any]:
    """Return the components of an entry such as ``{"x": 1, "y": 2, "z": 3}``."""
    found = member(value, key, dict, where)
    lacking = [axis for axis in axes if axis not in found]
    if lacking:
        raise BeamboxError(f"{where}.{key}: expected {', '.join(axes)}; {', '.join(lacking)} not there")
    return [found[axis] for axis in axes]
