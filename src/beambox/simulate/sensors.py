"""Spinning LiDARs: where their beams point, how far they see and how they err."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.io import read_yaml

__all__ = ["SENSORS", "Sensor", "load_sensor"]

MOST_RAYS = 4_000_000
"""Firings of a full turn; the densest sensors have 0.6 million."""
LIMITS = (("azimuth_step", 1e-3, 120), ("height", 0, 100), ("max_range", 0, 2000), ("min_range", 0, 2000),
          ("range_noise", 0, 10), ("intensity_step", 0, 1), ("sensitivity", 0, 1e6))  # fmt: skip
"""Field, least and greatest value."""


@dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR; the LiDAR frame is x forward, y left, z up, its origin ``height`` above the ground."""

    name: str
    """What the sensor is called in logs."""
    elevations: tuple[float, ...]
    """Angle of each beam above the horizon, degrees, in the order in which points are written."""
    azimuth_step: float
    """Degrees between two firings of one beam."""
    height: float
    """Metres from the ground to the origin of the LiDAR frame."""
    offsets: tuple[float, ...] = ()
    """Metres from the origin of the LiDAR frame up to where each beam leaves; empty: all leave at the origin."""
    range_noise: float = 0.02
    """Standard deviation of a measured distance, metres."""
    min_range: float = 0.9
    """Nearer surfaces give no return, metres."""
    max_range: float = 100.0
    """Farther surfaces give no return, metres."""
    sensitivity: float = 1.0
    """Factor on the received power; smaller values lose more far and dark surfaces."""
    intensity_step: float = 0.01
    """Intensities are multiples of this."""

    def __post_init__(self) -> None:
        if not self.elevations:
            raise BeamboxError("`elevations` must hold one angle per beam in degrees, got none")
        if any(not -90 < e < 90 for e in self.elevations):
            raise BeamboxError(f"`elevations` must lie between -90 and 90 degrees, got {min(self.elevations)} to "
                               f"{max(self.elevations)}")  # fmt: skip
        if self.offsets and len(self.offsets) != len(self.elevations):
            raise BeamboxError(
                f"`offsets` must be empty or one per beam ({len(self.elevations)}), got {len(self.offsets)}"
            )
        for name in ("azimuth_step", "height", "max_range", "sensitivity", "intensity_step"):
            value = {f.name: value for f, value in zip(fields(self), self._values())}[name]
            if not value > 0:
                raise BeamboxError(f"`{name}` must be greater than 0, got {value}")
        numbers = {f.name: value for f, value in zip(fields(self), self._values()) if f.name != "name"}
        for name, value in numbers.items():
            if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
                raise BeamboxError(
                    f"`{name}` must be finite, got {value if not isinstance(value, tuple) else 'inf or nan'}"
                )
        for name, least, most in LIMITS:
            if not least <= numbers[name] <= most:
                raise BeamboxError(f"`{name}` must lie between {least:g} and {most:g}, got {numbers[name]:g}")
        if len(self.elevations) * self.columns > MOST_RAYS:
            raise BeamboxError(
                f"a turn of {len(self.elevations)} beams every {self.azimuth_step:g} degrees fires "
                f"{len(self.elevations) * self.columns:,} times, expected at most {MOST_RAYS:,}"
            )
        if self.min_range >= self.max_range:
            raise BeamboxError(f"`min_range` {self.min_range} must be less than `max_range` {self.max_range}")
        if self.range_noise < 0:
            raise BeamboxError(f"`range_noise` must be at least 0, got {self.range_noise}")

    def _values(self) -> tuple:
        return tuple(self.__dict__[f.name] for f in fields(self))

    @property
    def columns(self) -> int:
        """Firings of one beam in a full turn."""
        return round(360.0 / self.azimuth_step)


# A unit of Velodyne's HDL-64E S2 as KITTI's car carried it. The manual gives two blocks of 32 lasers, about +2 to -8.33
# degrees in steps of 1/3 and -8.83 to -24.33 in steps of 1/2; each unit is calibrated one by one and deviates by up to
# half a degree. These are the calibrated angles of KITTI's unit, recovered from its published scans, where every beam
# obeys z = offset + distance * tan(elevation) to 0.3 mm.
_HDL64_UPPER = (
    1.937, 1.574, 1.305, 0.872, 0.579, 0.181, -0.089, -0.452, -0.803, -1.201, -1.494, -1.833, -2.208, -2.547, -2.874,
    -3.236, -3.539, -3.936, -4.216, -4.588, -4.914, -5.251, -5.611, -5.958, -6.329, -6.676, -6.999, -7.287, -7.679,
    -8.058, -8.310, -8.711,
)  # fmt: skip
_HDL64_LOWER = (
    -9.026, -9.573, -10.063, -10.471, -10.957, -11.599, -12.115, -12.562, -13.041, -13.484, -14.048, -14.599, -15.188,
    -15.657, -16.176, -16.554, -17.187, -17.730, -18.322, -18.797, -19.320, -19.736, -20.223, -20.788, -21.318, -21.935,
    -22.439, -22.856, -23.322, -23.971, -24.507, -25.000,
)  # fmt: skip

# Design values, degrees. Pandar40: the manual's appendix on channels (15.00, 11.00, 8.00, 5.00, 3.00, 2.00, 1.67, ...),
# the same as in Hesai's own driver HesaiLidar_General_SDK for units without a calibration file; a third of a degree
# from +2 to -6. Pandar64: that driver's table; about a sixth of a degree from +2 to -6.
_PANDAR40 = (
    15.0, 11.0, 8.0, 5.0, 3.0, *(round(2 - i / 3, 3) for i in range(25)),
    -7.0, -8.0, -9.0, -10.0, -11.0, -12.0, -13.0, -14.0, -19.0, -25.0,
)  # fmt: skip
_PANDAR64 = (
    14.882, 11.032, 8.059, 5.057, 3.040, 2.028, 1.860, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508, 0.337,
    0.169, 0.000, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351, -1.522, -1.688, -1.860, -2.028,
    -2.198, -2.365, -2.536, -2.700, -2.873, -3.040, -3.210, -3.375, -3.548, -3.712, -3.884, -4.050, -4.221, -4.385,
    -4.558, -4.720, -4.892, -5.057, -5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059, -9.060, -9.885,
    -11.032, -12.006, -12.974, -13.930, -18.889, -24.897,
)  # fmt: skip

SENSORS: dict[str, Sensor] = {
    "hdl64": Sensor(
        name="hdl64",
        elevations=_HDL64_UPPER + _HDL64_LOWER,
        offsets=tuple(0.209 - 0.011 * i / 31 for i in range(32)) + tuple(0.126 - 0.010 * i / 31 for i in range(32)),
        azimuth_step=0.1797,
        height=1.73,
        max_range=80.0,
    ),
    # Velodyne HDL-32E: 32 beams from +10.67 to -30.67 degrees in steps of 4/3, one of them level (application note
    # 63-9277 on the packet structure, and the manual); here on a low campus vehicle.
    "hdl32": Sensor(
        name="hdl32",
        elevations=tuple(round((32 - 4 * i) / 3, 3) for i in range(32)),
        azimuth_step=0.1667,
        height=1.2,
        max_range=80.0,
        sensitivity=0.8,
    ),
    # As high as on ONCE's cars: simulated cars then stand 1.70 m below the sensor on average (ONCE's anchors: 1.71).
    "pandar40": Sensor(
        name="pandar40",
        elevations=_PANDAR40,
        azimuth_step=0.2,
        height=1.75,
        max_range=120.0,
        sensitivity=1.5,
    ),
    "pandar64": Sensor(
        name="pandar64",
        elevations=_PANDAR64,
        azimuth_step=0.2,
        height=1.8,
        max_range=120.0,
        sensitivity=1.5,
    ),
}


def load_sensor(sensor: str | Path | Sensor) -> Sensor:
    """Return a sensor by preset name, from a YAML file whose keys are :class:`Sensor`'s fields, or as it is.

    Raises:
        MissingFileError: the file is not there.
        BeamboxError: an unknown preset, an unknown or missing key, or a value that does not fit.
    """
    if isinstance(sensor, Sensor):
        return sensor
    text = str(sensor)
    if text in SENSORS:
        return SENSORS[text]
    if not text.endswith((".yaml", ".yml")):
        raise BeamboxError(f"`sensor` must be a preset or a .yaml file, got {text!r}{did_you_mean(text, SENSORS)}")
    path = Path(text)
    if not path.is_file():
        raise MissingFileError(f"sensor file {path} is not there; give a preset ({', '.join(SENSORS)}) or a .yaml file")
    return _from_yaml(path)


def _from_yaml(path: Path) -> Sensor:
    values = read_yaml(path)
    if not isinstance(values, dict):
        raise BeamboxError(f"sensor file {path} must hold keys and values, got {type(values).__name__}")
    values.setdefault("name", path.stem)
    known = [f.name for f in fields(Sensor)]
    for key in values:
        if key not in known:
            raise BeamboxError(f"sensor file {path}: unknown key {key!r}{did_you_mean(str(key), known)}")
    missing = [key for key in ("elevations", "azimuth_step", "height") if key not in values]
    if missing:
        raise BeamboxError(f"sensor file {path} lacks {', '.join(missing)}")
    try:
        for key in ("elevations", "offsets"):
            if key in values:
                values[key] = tuple(float(v) for v in values[key])
        for key in set(values) - {"elevations", "offsets", "name"}:
            values[key] = float(values[key])
    except (TypeError, ValueError, OverflowError):
        raise BeamboxError(f"sensor file {path}: {key} must be numbers, got {str(values[key])[:60]!r}") from None
    values["name"] = str(values["name"])[:100]
    try:
        return Sensor(**values)
    except BeamboxError as error:
        raise BeamboxError(f"sensor file {path}: {error}") from None
