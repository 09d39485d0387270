"""What :mod:`beambox.metrics.box_errors` measures, as JSON and as a table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["BANDS", "COLUMNS", "Band", "BoxErrors", "ClassErrors"]

BANDS = (("overall", 0.0, math.inf), ("0-20m", 0.0, 20.0), ("20-40m", 20.0, 40.0), ("40m-inf", 40.0, math.inf))
"""Name and limits of each band: distance of the labelled centre from the sensor over the ground, metres."""
COLUMNS = ("x", "y", "z", "range", "along", "across", "length", "width", "height", "heading")
"""Signed errors: x, y, z of the sensor's frame; ``range``, away from the sensor over the ground; ``along`` and
``across``, forward and left in the labelled box's own frame (its z is the sensor's); sizes; heading, modulo pi."""


@dataclass(frozen=True)
class Band:
    """Errors of one class in one band of distance; NaN where nothing was found."""

    name: str
    """One of ``BANDS``."""
    objects: int
    """Objects that count."""
    matched: int
    """Those found, which the errors are of."""
    mean: Mapping[str, float]
    """Of each of ``COLUMNS``, detected minus labelled: metres, heading radians."""
    spread: Mapping[str, float]
    """Standard deviation of each (of the pairs themselves: over N, not N - 1)."""


@dataclass(frozen=True)
class ClassErrors:
    """Errors of one class."""

    name: str
    bands: tuple[Band, ...]
    """``overall`` first."""
    flipped: float
    """Percent of the found boxes that point the other way: more than 90 degrees off."""
    ate: float
    """nuScenes' average translation error, metres; NaN without objects, 1 below a recall of 0.1."""
    ase: float
    """nuScenes' average scale error, 1 - IoU of the sizes."""
    aoe: float
    """nuScenes' average orientation error, radians."""

    def __getitem__(self, name: str) -> Band:
        """Return a band by its name."""
        return next(band for band in self.bands if band.name == name)

    def to_json(self) -> dict[str, Any]:
        """Return numbers ready for ``json.dump``; null where there is none."""
        bands = {
            band.name: {
                "objects": band.objects,
                "matched": band.matched,
                **{key: {"mean": _number(band.mean[key]), "spread": _number(band.spread[key])} for key in COLUMNS},
            }
            for band in self.bands
        }
        scalars = {"flipped": self.flipped, "ATE": self.ate, "ASE": self.ase, "AOE": self.aoe}
        return {**bands, **{key: _number(value) for key, value in scalars.items()}}


@dataclass(frozen=True)
class BoxErrors:
    """Errors of every class."""

    classes: tuple[ClassErrors, ...]

    def __getitem__(self, name: str) -> ClassErrors:
        """Return the errors of a class."""
        return next(one for one in self.classes if one.name == name)

    def to_json(self) -> dict[str, Any]:
        """Return the numbers of each class."""
        return {one.name: one.to_json() for one in self.classes}

    def __str__(self) -> str:
        """Return the numbers as text, as :meth:`table` does."""
        return self.table()

    def table(self) -> str:
        """Return the numbers as text: centimetres and degrees, mean and spread."""
        lines = [
            "errors of matched boxes (BEV IoU > 0.25), detected - labelled: mean +- spread in cm, heading in degrees",
            "range: away from the sensor; along, across: forward and left in the object's own frame",
        ]
        for one in self.classes:
            lines += [
                "",
                f"{one.name}: ATE {_told(one.ate)} m, ASE {_told(one.ase)}, AOE {_told(one.aoe)} rad (nuScenes, 2 m); "
                f"{_told(one.flipped, 1)} % point the other way",
                f"{'':<9}{'found':>9}" + "".join(f"{name:>13}" for name in COLUMNS),
            ]
            for band in one.bands:
                cells = "".join(f"{_cell(band, name):>13}" for name in COLUMNS)
                lines.append(f"{band.name:<9}{f'{band.matched}/{band.objects}':>9}{cells}")
        return "\n".join(lines) + "\n"


def _cell(band: Band, column: str) -> str:
    if math.isnan(band.mean[column]):
        return "-"
    factor = 180 / math.pi if column == "heading" else 100
    return f"{factor * band.mean[column]:+.1f} +- {factor * band.spread[column]:.1f}"


def _told(value: float, digits: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 5)
