"""The small YAML file that says what a data set of one's own looks like."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.labels.catalog import FORMATS
from beambox.geometry.axes import Axes, level_shift
from beambox.io import read_yaml

__all__ = ["KITTI_GROUND", "CustomConfig", "GroundSlope", "read_custom_config"]

KITTI_GROUND = -1.73
"""Height of the ground in frames whose sensor height is known, metres: KITTI's, which shipped weights expect."""
EVERYTHING_ELSE = "*"
LABEL_FORMATS = ("kitti", "once", "pandaset", "csv", "json", *FORMATS)


class GroundSlope(BaseModel):
    """How the ground rises, in metres per metre, where the sensor is mounted askew or the road leans all along."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    forward: float = Field(default=0.0, ge=-0.3, le=0.3)
    """Metres that the ground rises a metre ahead."""
    left: float = Field(default=0.0, ge=-0.3, le=0.3)
    """Metres that the ground rises a metre to the left."""


class CustomConfig(BaseModel):
    """A data set of one's own; paths are relative to the YAML file, and ``{frame}`` stands for a frame's name."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    points: str
    """Sweeps, as ``velodyne/{frame}.bin``; any format that ``beambox detect`` reads."""
    labels: str | None = None
    """Boxes, as ``boxes/{frame}.txt``, or one file for all frames, as ``boxes.csv``; none where nobody labelled."""
    format: Literal[LABEL_FORMATS] | None = None  # pyright: ignore[reportInvalidTypeForm]
    """How the boxes are written: kitti, once, pandaset, csv, json, or as an annotation tool does (see
    docs/label_formats.md); found from the ending for .csv and .json."""
    calibration: str | None = None
    """For boxes in KITTI's text format: calib files, as ``calib/{frame}.txt``, or one file for all. Without it the
    boxes are taken to stand in a camera frame (x right, y down, z forward) at the sensor."""
    axes: str = "x: forward, y: left"
    """Where x and y of points and boxes lead."""
    sensor_height: float | None = Field(default=None, ge=-10, le=100)
    """Metres from the ground up to the origin of the points: 0 if z = 0 is the ground. Frames are then shifted so that
    the ground lies at -1.73 m, as in KITTI. Without it z stays as it is."""
    ground_slope: GroundSlope = GroundSlope()
    """How the ground rises; points and boxes are shifted in z so that it lies level."""
    fields: str | None = None
    """Columns of .bin and .npy files, as ``x,y,z,intensity,ring``; ``_`` leaves one out."""
    intensity_scale: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Factor that brings the intensity to 0..1; found from the numbers without it."""
    classes: dict[str, list[str]]
    """Class wanted -> names in the files that it takes in."""
    ignore: list[str] = []
    """Names in the files to leave out; ``"*"`` leaves out all that ``classes`` does not name."""
    range: tuple[float, float, float, float] | None = None
    """x0, y0, x1, y1 in metres, x forward, y left: what lies outside is left out, points and boxes. One number R stands
    for -R, -R, R, R."""
    min_points: int = Field(default=0, ge=0)
    """Boxes with fewer points inside are left out: nobody could find them."""
    splits: dict[str, str] = {}
    """Name of a split -> file with one frame name a line; ``all`` is always there."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, values: Any) -> Any:
        for key in values if isinstance(values, Mapping) else ():
            if key not in cls.model_fields:
                raise ValueError(f'unknown key "{key}"{did_you_mean(str(key), cls.model_fields)}')
        return values

    @field_validator("classes", mode="before")
    @classmethod
    def _one_name_or_several(cls, value: Any) -> Any:
        if isinstance(value, list):
            return {str(name): [str(name)] for name in value}
        if isinstance(value, Mapping):
            return {
                str(name): [str(name)] if names is None else [names] if isinstance(names, str) else names
                for name, names in value.items()
            }
        return value

    @field_validator("range", mode="before")
    @classmethod
    def _one_number_or_four(cls, value: Any) -> Any:
        if isinstance(value, int) and abs(value) > 10**9:
            raise ValueError("range is far beyond any sensor")
        return (-value, -value, value, value) if isinstance(value, int | float) and value > 0 else value

    @field_validator("axes")
    @classmethod
    def _readable_axes(cls, value: str) -> str:
        if not Axes.parse(value).vertical_z:
            raise ValueError(f"z must lead up or down, or boxes could not turn about it; got {Axes.parse(value)}")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> CustomConfig:
        for key in ("points", "labels", "calibration"):
            if "\0" in (getattr(self, key) or ""):
                raise ValueError(f"{key} holds a zero byte")
        if "{frame}" not in self.points:
            raise ValueError(f"points must contain {{frame}}, as velodyne/{{frame}}.bin; got {self.points!r}")
        if not self.classes:
            raise ValueError("classes must name at least one class")
        if self.labels is not None and self.label_format is None:
            raise ValueError(f"format must say how {self.labels} is written: kitti, once, pandaset, csv or json")
        taken: dict[str, str] = {}
        for wanted, names in self.classes.items():
            for name in names:
                if name in taken or name in self.ignore:
                    raise ValueError(f"the name {name!r} stands in {taken.get(name, 'ignore')} and in {wanted}")
                taken[name] = wanted
        if self.range is not None and not all(map(math.isfinite, self.range)):
            raise ValueError(f"range must be finite numbers of metres, got {list(self.range)}")
        if self.range is not None and not (self.range[0] < self.range[2] and self.range[1] < self.range[3]):
            raise ValueError(f"range is x0, y0, x1, y1 with x0 < x1 and y0 < y1, got {list(self.range)}")
        return self

    @property
    def label_format(self) -> str | None:
        """How the boxes are written."""
        if self.format is not None or self.labels is None:
            return self.format
        return {".csv": "csv", ".json": "json"}.get(Path(self.labels).suffix.lower())

    @property
    def z_offset(self) -> float:
        """Metres added to z, after the axes have been turned."""
        return 0.0 if self.sensor_height is None else self.sensor_height + KITTI_GROUND

    def shift(self, rows: Tensor) -> Tensor:
        """Metres added to z of points or boxes whose axes have been turned, ``(N,)``: KITTI's height, level ground."""
        return level_shift(rows, self.z_offset, (self.ground_slope.forward, self.ground_slope.left))

    def class_of(self, name: str, where: str) -> str | None:
        """Return the class wanted for a name in the files, or None to leave it out.

        Raises:
            BeamboxError: if neither ``classes`` nor ``ignore`` names it.
        """
        for wanted, names in self.classes.items():
            if name in names:
                return wanted
        if name in self.ignore or EVERYTHING_ELSE in self.ignore:
            return None
        known = [name for names in self.classes.values() for name in names]
        raise BeamboxError(
            f'{where}: neither `classes` nor `ignore` names the class "{name}"{did_you_mean(name, known)}; '
            f'ignore: ["*"] leaves out all others'
        )


def read_custom_config(path: Path) -> CustomConfig:
    """Read and check the YAML file.

    Raises:
        BeamboxError: naming the file and every key that is wrong.
    """
    values = read_yaml(path)
    if not isinstance(values, dict):
        raise BeamboxError(f"{path} must hold keys such as points, labels and classes")
    try:
        return CustomConfig.model_validate(values)
    except ValidationError as error:
        faults = []
        for fault in error.errors():
            place = ".".join(str(part) for part in fault["loc"])
            text = fault["msg"].removeprefix("Value error, ")[:300]
            faults.append(f"{place}: {text}" if place else text)
        raise BeamboxError(f"{path}: " + "; ".join(faults[:5])) from None
