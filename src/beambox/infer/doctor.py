"""Why are there no detections? A sweep is compared with what the weights were trained on, and a remedy is named."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beambox.data.ground_plane import fit_ground_plane, height_and_slope
from beambox.data.placements import up_axis
from beambox.data.read_points import read_frame
from beambox.geometry.axes import Axes
from beambox.infer.sensor_alignment import SensorAlignment
from beambox.infer.sensor_profile import SensorProfile
from beambox.structures import Frame

__all__ = ["Diagnosis", "Finding", "diagnose"]

STEEP = 0.03
"""A ground that rises by more than this is told of, metres per metre; KITTI's rises by 0.008 on average."""

Level = Literal["good", "note", "bad"]


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    about: str
    """What, in a word or two."""
    level: Level
    """"bad" explains missing detections, "note" is worth knowing."""
    text: str
    """What was found, with numbers."""
    option: tuple[str, ...] = ()
    """What to pass to `beambox detect`, as words of the command line."""


@dataclass(frozen=True)
class Diagnosis:
    """All findings of a sweep."""

    findings: tuple[Finding, ...]
    """In the order in which they were looked at."""
    alignment: SensorAlignment = field(default_factory=SensorAlignment)
    """What the remedies do to the points."""
    intensity_scale: float | None = None
    """Remedy for the intensity."""

    @property
    def options(self) -> tuple[str, ...]:
        """All remedies, as words of the command line."""
        return tuple(word for finding in self.findings for word in finding.option)


def diagnose(path: Path | str, sensor_profile: SensorProfile, fields: str | Sequence[str] | None = None) -> Diagnosis:
    """Compare a sweep with the training data.

    Axes are judged first; height and range on the points with their axes put right.

    Args:
        path: the sweep.
        sensor_profile: what the weights know.
        fields: names of the columns of a file that does not name them.

    Raises:
        BeamboxError: if the file cannot be read at all.
    """
    frame = read_frame(path, fields=fields)
    findings = [Finding("reading", "note", note) for note in frame.notes]
    if not len(frame):
        return Diagnosis((*findings, Finding("points", "bad", "the sweep has no points")))
    units = _units(frame.points)
    findings += [units]
    if units.level == "bad":  # what follows would measure metres that are none
        return Diagnosis(tuple(findings))
    axes_finding, axes = _axes(frame.points)
    turned = SensorAlignment(axes).apply(frame).points
    plane = fit_ground_plane(turned)
    height_finding, raised = _height(plane, sensor_profile)
    fixed = turned.clone()
    fixed[:, 2] += raised
    bright_finding, scale = _intensity(frame, path, sensor_profile, fields)
    findings += [axes_finding, height_finding, _slope(plane)]
    findings += [_range(turned, fixed, sensor_profile), _density(fixed, sensor_profile), bright_finding]
    kept = tuple(finding for finding in findings if finding is not None)
    return Diagnosis(kept, SensorAlignment(axes, raised), scale)


def _units(points: Tensor) -> Finding:
    distance = points[:, :3].double().norm(dim=1)
    far = float(torch.quantile(distance[:: max(1, len(distance) // 100_000)], 0.95))
    text = f"{len(points):,} points, 95% within {far:.4g} of the origin"
    if far > 1000:
        return Finding("points", "bad", f"{text}: metres around the sensor are expected; these look like millimetres "
                       "(divide them by 1000 first) or map coordinates (subtract the sensor's position first); nothing "
                       "else was looked at")  # fmt: skip
    if far < 3:
        return Finding(
            "points", "bad", f"{text}: metres are expected; multiply first (by 1000 if these are kilometres)"
        )
    nothing = int((distance < 1e-6).sum())
    if nothing:
        text += f"; {nothing:,} lie exactly at the origin (laser pulses without an echo): harmless"
    return Finding("points", "good", text)


def _axes(points: Tensor) -> tuple[Finding, Axes]:
    """Find which axis is up by the layer of the ground, and where the points lie if they do not lie all around."""
    up = up_axis(points)
    if up is not None:
        axes = _axes_from_up(up)
        text = f"the ground is a layer across the {up[-1]} axis and {up} is up, but the network takes +z for up"
        return Finding("axes", "bad", text, ("--axes", str(axes))), axes
    sector = _sector(points)
    if sector is None:
        return Finding("axes", "note", "z is up; points lie all around, so x cannot be told from y: if yours is not "
                       'forward, pass --axes, such as "x: right, y: forward"'), Axes()  # fmt: skip
    middle, width = sector
    quarter = round(middle / 90) % 4
    axes = (Axes(), Axes("right", "forward"), Axes("backward", "right"), Axes("left", "backward"))[quarter]
    text = f"z is up; points fill {width:.0f} degrees around the direction {middle:+.0f} (0 is +x, 90 is +y)"
    if quarter == 0:
        return Finding("axes", "good", text + ", ahead as expected"), axes
    return Finding("axes", "bad", text + ", but the network looks along +x", ("--axes", str(axes))), axes


def _axes_from_up(up: str) -> Axes:
    """Return the usual frame with that axis up: forward and left follow from common conventions."""
    return {
        "-y": Axes("right", "down", "forward"),  # a camera's
        "+y": Axes("left", "up", "forward"),  # y up, as in computer graphics, z ahead
        "-z": Axes("forward", "right", "down"),  # aviation's
        "+x": Axes("up", "left", "backward"),
        "-x": Axes("down", "left", "forward"),
    }[up]


def _sector(points: Tensor) -> tuple[float, float] | None:
    """Return (middle, width) in degrees of the directions in which points lie, or None where they lie all around."""
    xy = points[:, :2].double()
    xy = xy[xy.norm(dim=1) > 2]
    if not len(xy):
        return None
    angle = torch.rad2deg(torch.atan2(xy[:, 1], xy[:, 0])).numpy()
    counts = np.histogram(angle, bins=72, range=(-180, 180))[0]
    empty = np.flatnonzero(counts > 0.1 * len(xy) / 72)
    gaps = np.diff(np.append(empty, empty[0] + 72))  # steps from one direction with points to the next
    widest = int(gaps.argmax())
    if gaps[widest] * 5 < 120:
        return None
    width = 360 - (gaps[widest] - 1) * 5
    start = empty[(widest + 1) % len(empty)] * 5 - 180
    return float((start + width / 2 + 180) % 360 - 180), float(width)


def _height(plane: Tensor | None, sensor_profile: SensorProfile) -> tuple[Finding, float]:
    if plane is None:
        return Finding("height", "note", "too few points near the sensor to find the ground"), 0.0
    ground, slope = height_and_slope(plane)
    height, tilt = -ground, math.degrees(math.atan(math.hypot(*slope)))
    text = f"the ground lies {height:.2f} m below z = 0, in training {sensor_profile.sensor_height:.2f} m"
    if tilt > 6:
        return Finding("height", "note", f"{text}, but it is tilted by {tilt:.0f} degrees: level the points first"), 0.0
    if abs(height - sensor_profile.sensor_height) <= 0.3:
        return Finding("height", "good", text), 0.0
    option = ("--sensor-height", f"{round(height, 2) + 0.0:g}")
    return Finding("height", "bad", text, option), round(height, 2) - sensor_profile.sensor_height


def _slope(plane: Tensor | None) -> Finding | None:
    """Tell of a ground that leans: one sweep cannot say whether the road does so or the sensor, so this is a note."""
    if plane is None:
        return None
    forward, left = (round(rise, 3) + 0.0 for rise in height_and_slope(plane)[1])
    if not STEEP < math.hypot(forward, left) < math.tan(math.radians(6)):
        return None
    return Finding(
        "slope",
        "note",
        f"the ground rises by {forward:.1%} forward and {left:.1%} to the left, in training hardly; "
        f"if every sweep says so, --ground-slope {forward:g},{left:g} makes it level",
    )


def _range(given: Tensor, fixed: Tensor, sensor_profile: SensorProfile) -> Finding:
    low, high = sensor_profile.grid.minimum, sensor_profile.grid.maximum
    inside = float(sensor_profile.grid.index(given)[1].float().mean())
    then = float(sensor_profile.grid.index(fixed)[1].float().mean())
    text = (
        f"{inside:.0%} of the points lie where the network looks (x {low[0]:g} to {high[0]:g}, "
        f"y {low[1]:g} to {high[1]:g}, z {low[2]:g} to {high[2]:g} m)"
    )
    if then > inside + 0.05:
        text += f"; with the height put right {then:.0%}"
    if max(inside, then) < 0.02:
        some = given[:: max(1, len(given) // 100_000), :2].abs()  # quantile takes no more than 16 million
        reach = min(100, max(20, 10 * round(float(some.quantile(0.9)) / 10)))
        return Finding("range", "bad", text, ("--range", f"{reach}"))
    behind = float((given[:, 0] < low[0]).float().mean())
    if behind > 0.3:
        return Finding("range", "note", f"{text}; {behind:.0%} lie behind that: --range 50 looks all around")
    return Finding("range", "good", text)


def _density(points: Tensor, sensor_profile: SensorProfile) -> Finding:
    inside = int(sensor_profile.grid.index(points)[1].sum())
    text = f"{inside:,} points where the network looks, in training about {sensor_profile.points:,}"
    if inside < sensor_profile.points / 5:
        return Finding(
            "density", "note", f"{text}: a sparser sensor is seen less far; near objects should still be found"
        )
    return Finding("density", "good", text)


def _intensity(
    frame: Frame, path: Path | str, sensor_profile: SensorProfile, fields: str | Sequence[str] | None
) -> tuple[Finding, float | None]:
    """Compare the mean intensity; look for the factor that explains a difference."""
    mean = float(frame.points[:, 3].double().mean())
    details = f"mean {mean:.3f} {spark(frame.points[:, 3])}, in training {sensor_profile.intensity_mean:.2f}"
    if not bool(frame.points[:, 3].any()):
        return Finding(
            "intensity", "note", "there is none (all 0): the network was trained with it and will be less sure"
        ), None
    ratio = mean / sensor_profile.intensity_mean
    if 1 / 3 <= ratio <= 3:
        return Finding("intensity", "good", details), None
    tiny = 1e-9  # reading with such a factor keeps large values from being clipped to 1
    raw = read_frame(path, fields=fields, intensity_scale=tiny).points[:, 3].double() / tiny
    usual = [1.0, 1 / 100, 1 / 255, 1 / 4095, 1 / 65535]
    scale = min(usual, key=lambda s: abs(math.log(max(float(raw.mean()) * s, 1e-12) / sensor_profile.intensity_mean)))
    if not 1 / 3 <= float(raw.mean()) * scale / sensor_profile.intensity_mean <= 3:
        scale = sensor_profile.intensity_mean / float(raw.mean())  # no usual unit explains it: match the mean
    scale = float(f"{scale:.2g}")
    return Finding("intensity", "bad", details, ("--intensity-scale", f"{scale:g}")), scale


def spark(values: Tensor) -> str:
    """Draw a histogram over [0, 1] in ten characters."""
    counts = np.histogram(values.numpy(), bins=10, range=(0, 1))[0]
    bars = " ▁▂▃▄▅▆▇█"
    heights = np.ceil(8 * counts / max(1, counts.max())).astype(int)
    return "[" + "".join(bars[h] for h in heights) + "]"
