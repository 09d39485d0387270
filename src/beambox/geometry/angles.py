"""Angles as plain numbers; :mod:`beambox.geometry.boxes` has them as tensors."""

from __future__ import annotations

import math

__all__ = ["wrap"]


def wrap(angle: float) -> float:
    """Return an angle in [-pi, pi], radians, as it is where it lies there already."""
    return angle if -math.pi <= angle <= math.pi else math.remainder(angle, 2 * math.pi)
