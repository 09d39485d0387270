"""What a tracker assumes of sensors and objects; each with its unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType

from beambox.checks import BeamboxError

__all__ = ["TrackerOptions"]


@dataclass(frozen=True)
class TrackerOptions:
    """Options of :class:`beambox.track.Tracker`."""

    score_threshold: float = 0.1
    """Detections below this score are left out."""
    birth_score: float = 0.3
    """A detection that continues no track starts one from this score on."""
    confirm_score: float = 0.5
    """A track is reported once its score, the running mean of its detections', has reached this."""
    death_score: float = 0.1
    """A track ends when its score has fallen below this and a sweep has no detection of it."""
    memory: float = 0.5
    """Seconds over which the score of a track is averaged; without a detection it falls to 1 / e in this time."""
    coast: float = 0.0
    """Seconds for which a track without a detection is reported at its predicted place."""
    gate: float = 13.8
    """Largest squared Mahalanobis distance, in BEV, between a track and its detection (13.8: 99.9 %)."""
    position_noise: float = 0.17
    """Standard deviation of the center of a detection along each axis, metres (0.17 measured on KITTI val cars)."""
    size_noise: float = 0.2
    """Standard deviation of length, width and height of a detection, metres."""
    heading_noise: float = 0.15
    """Standard deviation of the heading of a detection, radians."""
    acceleration: float = 4.0
    """Standard deviation of the acceleration that a constant velocity leaves out, metres per second squared."""
    turn: float = 0.5
    """Standard deviation by which a heading changes in a second, radians."""
    speed: float = 10.0
    """Standard deviation of the velocity of an object that has just been found, along each axis, metres per second."""
    speeds: Mapping[str, float] = field(
        default_factory=lambda: MappingProxyType({"Pedestrian": 1.5, "Person": 1.5, "Cyclist": 5.0})
    )
    """The same for single classes, by name."""

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            numbers = list(value.values()) if isinstance(value, Mapping) else [value]
            for number in numbers:
                if not (isinstance(number, int | float) and math.isfinite(number) and number >= 0):
                    raise BeamboxError(f"`{one.name}` must be a finite number of at least 0, got {number!r}")
        for name in ("position_noise", "size_noise", "heading_noise", "memory", "gate"):
            if getattr(self, name) == 0:
                raise BeamboxError(f"`{name}` must be above 0")
        if self.birth_score < self.score_threshold:
            raise BeamboxError(
                f"`birth_score` ({self.birth_score}) must be at least `score_threshold` ({self.score_threshold}): what "
                "is left out starts no track"
            )
        if not self.death_score < self.confirm_score <= 1:
            raise BeamboxError(
                f"`confirm_score` must lie above `death_score` ({self.death_score}) and be at most 1, "
                f"got {self.confirm_score}"
            )
