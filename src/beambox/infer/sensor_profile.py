"""What weights know of the sensor they were trained on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from beambox.geometry import VoxelGrid

__all__ = ["SensorProfile"]


@dataclass(frozen=True)
class SensorProfile:
    """What the training data of a set of weights looked like; the defaults are KITTI's."""

    grid: VoxelGrid
    """Region the network looks at."""
    sensor_height: float = 1.73
    """Metres of the sensor above the ground."""
    intensity_mean: float = 0.23
    """Mean intensity of the points."""
    points: int = 18_000
    """Points of a typical sweep that the network saw."""

    @classmethod
    def of(cls, card: Mapping[str, Any], grid: VoxelGrid) -> SensorProfile:
        """Read "sensor height", "intensity mean" and "points" of a card; what it does not say is as in KITTI."""
        entries = {key.replace(" ", "_"): value for key, value in card.items()}
        known = {key: entries[key] for key in ("sensor_height", "intensity_mean", "points") if key in entries}
        return cls(grid, **known)
