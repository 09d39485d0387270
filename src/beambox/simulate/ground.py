"""The ground: a sloped, bent and uneven height field with roads, kerbs, pavements and grass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

__all__ = ["GRASS", "MARKING", "PAVEMENT", "ROAD", "Ground", "Road", "ground_height", "ground_surface"]

ROAD, PAVEMENT, GRASS, MARKING = 0, 1, 2, 3
_BASE, _WAVE, _ROAD = 12, 4, 10  # numbers that describe the base shape, one wave, one road
_FADE = 4900.0  # square metres; bends of the ground fade out beyond 70 m


@dataclass(frozen=True)
class Road:
    """A straight or evenly bent strip of asphalt with kerbs."""

    angle: float
    """Direction, radians."""
    offset: float
    """Metres from the sensor to the centre line, to the left of the direction."""
    half_width: float
    """Metres from the centre line to the kerb."""
    kerb: float
    """Height of the kerb, metres."""
    pavement: float
    """Width of the pavement, metres; grass lies beyond."""
    bend: float = 0.0
    """Curvature of the centre line, 1/m."""
    lane: float = 3.3
    """Distance between lane markings, metres."""
    marked: float = 1.0
    """Whether markings are painted, 0 or 1."""


@dataclass(frozen=True)
class Ground:
    """Height over the x-y plane: plane, bend, waves and roads."""

    height: float
    """z below the sensor, metres."""
    slope: tuple[float, float]
    """Rise along x and y."""
    bend: tuple[float, float]
    """Half the curvature along x and y, 1/m."""
    waves: np.ndarray
    """(W, 4) amplitude, wave numbers along x and y, phase."""
    roads: tuple[Road, ...]
    """Where asphalt lies; everything else is pavement or grass."""
    crown: float = 0.02
    """How much the middle of a road lies above its kerb stones, metres."""
    bank: float = 0.0
    """Rise of the grass away from the pavement."""
    bank_limit: float = 0.5
    """Greatest height of that bank, metres."""
    roughness: tuple[float, float, float] = (0.004, 0.006, 0.04)
    """How far single returns scatter upwards on road, pavement, grass, metres."""

    def pack(self) -> np.ndarray:
        """Return everything as one float64 array for the compiled functions."""
        base = [self.height, *self.slope, *self.bend, self.crown, self.bank, self.bank_limit, len(self.waves),
                *self.roughness]  # fmt: skip
        roads = [
            [math.cos(r.angle), math.sin(r.angle), r.offset, r.half_width, r.kerb, r.pavement, r.bend, r.lane,
             r.marked, 0.0]
            for r in self.roads
        ]  # fmt: skip
        return np.concatenate((np.array(base), np.ravel(self.waves), np.ravel(roads))).astype(np.float64)

    def tilt(self, packed: np.ndarray, x: float, y: float, yaw: float, length: float, width: float) -> np.ndarray:
        """Return ``(3,)`` z and the rise along and across a footprint that stands on the ground."""
        c, s = math.cos(yaw), math.sin(yaw)
        front, rear = (ground_height(packed, x + k * length * c, y + k * length * s) for k in (0.33, -0.33))
        left, right = (ground_height(packed, x - k * width * s, y + k * width * c) for k in (0.4, -0.4))
        across = (left - right) / (0.8 * width)
        return np.array([(front + rear + left + right) / 4, (front - rear) / (0.66 * length), across])


@numba.njit(cache=True, nogil=True)
def _outside(g: np.ndarray, x: float, y: float) -> tuple[float, int, float, float]:
    """Signed distance to the nearest road's edge (negative on the road), its index, and place across and along it."""
    start = _BASE + int(g[8]) * _WAVE
    best, road, across, along = 1e9, -1, 0.0, 0.0
    for k in range((len(g) - start) // _ROAD):
        r = start + k * _ROAD
        u = g[r] * x + g[r + 1] * y
        s = g[r] * y - g[r + 1] * x - g[r + 2] - 0.5 * g[r + 6] * u * u
        excess = abs(s) - g[r + 3]
        if excess < best:
            best, road, across, along = excess, r, s, u
    return best, road, across, along


@numba.njit(cache=True, nogil=True)
def ground_height(g: np.ndarray, x: float, y: float) -> float:
    """Height of the ground at a place, metres; ``g`` from :meth:`Ground.pack`."""
    z = g[0] + g[1] * x + g[2] * y + (g[3] * x * x + g[4] * y * y) / (1 + (x * x + y * y) / _FADE)
    for k in range(int(g[8])):
        w = _BASE + k * _WAVE
        z += g[w] * math.sin(g[w + 1] * x + g[w + 2] * y + g[w + 3])
    excess, road, across, _ = _outside(g, x, y)
    if road < 0:
        return z
    if excess <= 0:
        return z + g[5] * (1 - (across / g[road + 3]) ** 2)
    z += g[road + 4] * min(1.0, excess / 0.04)
    if excess > g[road + 5]:
        rise = g[6] * (excess - g[road + 5])
        z += min(max(rise, -g[7]), g[7])
    return z


@numba.njit(cache=True, nogil=True)
def ground_surface(g: np.ndarray, x: float, y: float) -> int:
    """What lies at a place: ROAD, PAVEMENT, GRASS or MARKING."""
    excess, road, across, along = _outside(g, x, y)
    if road < 0:
        return GRASS
    if excess > g[road + 5]:
        return GRASS
    if excess > 0:
        return PAVEMENT
    if g[road + 8] > 0.5:
        lane = g[road + 7]
        beside = abs(across - lane * round(across / lane))
        dashed = along / 9.0 - math.floor(along / 9.0) < 0.45
        if beside < 0.07 and dashed and excess < -0.8:
            return MARKING
    return ROAD
