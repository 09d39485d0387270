"""Where the points of real and of simulated objects lie in their boxes: what a simulator has to get right.

A detector that learned from simulated sweeps inherits every systematic difference: bodies that fill their boxes better
than real ones do move its boxes away from the sensor, windows that return too much raise them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from beambox.checks import BeamboxError
from beambox.data.source import FrameSource
from beambox.geometry.boxes import world_to_local
from beambox.structures import Frame

__all__ = ["BANDS", "RANGES", "Comparison", "Profile", "compare_objects", "object_profiles"]

BANDS = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 1.05)
"""Borders of the bands of height, as shares of the box's height."""
RANGES = ((5.0, 14.0), (14.0, 22.0), (22.0, 32.0), (32.0, 45.0), (45.0, 60.0))
"""Distances from the sensor that are told apart, metres."""
_MARGIN, _GROUND = 0.15, 0.1  # metres around a box that still count; above its lower face that do not (the road)
_MEASURES = ("points", "depth", "top gap", "lowest", "intensity", "zero")


@dataclass(frozen=True)
class Profile:
    """One object's points, in its box."""

    name: str
    """Class."""
    view: str
    """``rear``, ``front`` or ``side``: what of it faces the sensor."""
    distance: float
    """From the sensor, metres."""
    measures: tuple[float, ...]
    """Points; depth of the nearest tenth behind the box's nearest extent along the ray, metres; gap between the box's
    top and the highest points, metres; height of the lowest points, metres; mean intensity; share of intensity 0."""
    bands: tuple[float, ...]
    """Share of the points in each band of height, see :data:`BANDS`."""


def _profile(name: str, box: np.ndarray, points: np.ndarray, least: int) -> Profile | None:
    x, y, _, length, width, height, yaw = box
    near = points[np.abs(points[:, 0] - x) + np.abs(points[:, 1] - y) < length + width]
    local = world_to_local(torch.from_numpy(near[None, :, :3].astype(np.float64)), torch.from_numpy(box[None]))
    u, v, w = local[0].numpy().T  # (N,) each
    up = w + height / 2
    inside = (np.abs(u) < length / 2 + _MARGIN) & (np.abs(v) < width / 2 + _MARGIN)
    inside &= (up > _GROUND) & (up < height + _MARGIN)
    if inside.sum() < least:
        return None
    distance = float(np.hypot(x, y))
    facing = (yaw - np.arctan2(y, x) + np.pi) % (2 * np.pi) - np.pi
    view = "rear" if abs(facing) < np.pi / 6 else "front" if abs(facing) > np.pi * 5 / 6 else "side"
    extent = length / 2 * abs(np.cos(facing)) + width / 2 * abs(np.sin(facing))
    nearness = -((near[inside, :2] - (x, y)) @ (x, y)) / distance  # towards the sensor, from the box's center
    share, intensity = up[inside] / height, near[inside, 3] if near.shape[1] > 3 else np.zeros(inside.sum())
    measures = (
        float(inside.sum()),
        float(extent - np.percentile(nearness, 90)),
        float(height - np.percentile(up[inside], 98)),
        float(np.percentile(up[inside], 2)),
        float(intensity.mean()),
        float((intensity == 0).mean()),
    )
    counts = np.histogram(share, BANDS)[0]
    return Profile(name, view, distance, measures, tuple(counts / max(1, counts.sum())))


def object_profiles(frames: Iterable[Frame], classes: Sequence[str], least: int = 10) -> list[Profile]:
    """Measure every object in plain sight.

    Args:
        frames: with labels.
        classes: to look at.
        least: objects with fewer points are left out, as are those that something hides in part.
    """
    profiles = []
    for frame in frames:
        labels = frame.labels
        if labels is None:
            raise BeamboxError(f"frame {frame.id} has no labels; a comparison of objects needs them")
        seen = torch.ones(len(labels.names), dtype=torch.bool)
        if labels.attributes is not None:
            seen = labels.attributes.occlusion == 0
        points = frame.points.numpy()
        for k, (name, box) in enumerate(zip(labels.names, labels.boxes.double().numpy())):
            if name in classes and bool(seen[k]):
                profile = _profile(name, box, points, least)
                profiles += [profile] if profile else []
    return profiles


@dataclass(frozen=True)
class Comparison:
    """Real beside simulated objects, by class, view and distance."""

    rows: tuple[tuple[str, str, tuple[float, float], str, int, tuple[float, ...], tuple[float, ...]], ...]
    """Class, view, range of distances, ``real`` or ``simulated``, number of objects, medians of the measures of
    :class:`Profile`, mean shares of the bands of height."""

    def table(self) -> str:
        """Return everything as text, real above simulated."""
        bands = "".join(f"{100 * low:4.0f}+" for low in BANDS[:-1])
        lines = [f"{'':36}{'objects':>8}" + "".join(f"{name:>10}" for name in _MEASURES) + f"  % by height:{bands}"]
        for name, view, (low, high), origin, count, measures, shares in self.rows:
            place = f"{name:11}{view:6}{low:3.0f}-{high:2.0f} m {origin:10}"
            numbers = f"{measures[0]:10.0f}" + "".join(f"{value:10.2f}" for value in measures[1:])
            lines.append(f"{place:36}{count:8}{numbers}{'':14}" + "".join(f"{100 * share:5.0f}" for share in shares))
        return "\n".join(lines) + "\n"


def compare_objects(
    real: FrameSource, simulated: FrameSource, classes: Sequence[str] = ("Car", "Pedestrian", "Cyclist")
) -> Comparison:
    """Compare where points lie in the boxes of two data sets.

    Only combinations of class, view and distance of which both hold at least four objects are told.

    Args:
        real: frames with labels.
        simulated: the same, made up.
        classes: to look at.
    """
    both = {
        origin: object_profiles((source[i] for i in range(len(source))), classes)
        for origin, source in (("real", real), ("simulated", simulated))
    }
    rows = []
    for name in classes:
        for view in ("rear", "front", "side"):
            for low, high in RANGES:
                chosen = {
                    origin: [p for p in profiles if p.name == name and p.view == view and low <= p.distance < high]
                    for origin, profiles in both.items()
                }
                if min(map(len, chosen.values())) < 4:
                    continue
                for origin, some in chosen.items():
                    measures = tuple(np.median([p.measures for p in some], axis=0).tolist())
                    bands = tuple(np.mean([p.bands for p in some], axis=0).tolist())
                    rows.append((name, view, (low, high), origin, len(some), measures, bands))
    return Comparison(tuple(rows))
