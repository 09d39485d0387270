"""Where a scene is put together: ground, materials and objects that do not overlap."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from beambox.simulate import people, vehicles
from beambox.simulate.ground import Ground, ground_height
from beambox.simulate.materials import Palette
from beambox.simulate.object_mix import KITTI_MIX, ObjectMix, draw_size
from beambox.simulate.raycast import Placed
from beambox.simulate.shapes import Shape, rotation

__all__ = ["Stage", "overlaps"]

CLEARANCE = 0.12
"""Metres that scenery keeps from an object's box at least, so that what a box holds is the object's."""


def overlaps(rectangle: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Tell which of ``(N, 5)`` rectangles x, y, half-length, half-width, yaw overlap one ``(5,)``: ``(N,)`` bool."""
    if not len(others):
        return np.zeros(0, dtype=bool)
    apart = np.zeros(len(others), dtype=bool)
    away = others[:, :2] - rectangle[:2]
    axes = [np.broadcast_to((math.cos(a), math.sin(a)), away.shape) for a in (rectangle[4], rectangle[4] + math.pi / 2)]
    axes += [np.stack((np.cos(a), np.sin(a)), axis=1) for a in (others[:, 4], others[:, 4] + math.pi / 2)]

    def reach(half: np.ndarray, yaw: np.ndarray | float, axis: np.ndarray) -> np.ndarray:
        c, s = np.cos(yaw), np.sin(yaw)
        along, across = c * axis[:, 0] + s * axis[:, 1], c * axis[:, 1] - s * axis[:, 0]
        return half[..., 0] * np.abs(along) + half[..., 1] * np.abs(across)

    for axis in axes:
        distance = np.abs((away * axis).sum(axis=1))
        apart |= distance > reach(rectangle[2:4], rectangle[4], axis) + reach(others[:, 2:4], others[:, 4], axis)
    return ~apart


_BUILDERS = {
    "Car": vehicles.car,
    "Van": vehicles.van,
    "Truck": vehicles.truck,
    "Bus": vehicles.bus,
    "Tram": vehicles.tram,
    "Misc": vehicles.trailer,
    "Pedestrian": people.pedestrian,
    "Person_sitting": people.sitting,
    "Cyclist": people.cyclist,
}


@dataclass
class Stage:
    """A scene in the making."""

    ground: Ground
    """What everything stands on."""
    palette: Palette
    """The scene's materials."""
    rng: np.random.Generator
    """Source of all choices."""
    ahead: float = 0.0
    """How far behind the sensor things are put, as a negative x in metres; 0 for the camera's view."""
    guard: bool = False
    """Whether scenery must not hide objects."""
    object_mix: ObjectMix = KITTI_MIX
    """Which objects there are."""
    placed: list[Placed] = field(default_factory=list)
    """Everything so far."""

    def __post_init__(self) -> None:
        self.packed_ground = self.ground.pack()
        self._taken = np.zeros((0, 5))
        self._views: list[tuple[float, float, float]] = []  # azimuth, half-width, distance of each object
        self._occupy(0.8, 0.0, 3.2, 1.3, 0.0)

    def _occupy(self, x: float, y: float, half_length: float, half_width: float, yaw: float) -> None:
        self._taken = np.concatenate((self._taken, [[x, y, half_length, half_width, yaw]]))

    def free(self, x: float, y: float, length: float, width: float, yaw: float, gap: float = 0.15) -> bool:
        """Tell whether a footprint touches nothing that is there."""
        rectangle = np.array([x, y, length / 2 + gap, width / 2 + gap, yaw])
        away = np.hypot(self._taken[:, 0] - x, self._taken[:, 1] - y)
        near = away < np.hypot(self._taken[:, 2], self._taken[:, 3]) + math.hypot(rectangle[2], rectangle[3])
        return not bool(overlaps(rectangle, self._taken[near]).any())

    def sees(self, x: float, y: float, reach: float = 6.0) -> bool:
        """Tell whether something of that reach at a place can get beams: everywhere, or before the camera."""
        return self.ahead < 0 or (x > -reach and abs(y) < 0.95 * max(x, 0.0) + 1.5 * reach)

    def add_object(
        self, name: str, x: float, y: float, yaw: float, size: tuple[float, float, float] | None = None,
        bottom: float | None = None, force: bool = False,
    ) -> bool:  # fmt: skip
        """Put an object of a kind where nothing stands; returns whether it fitted.

        Args:
            name: a kind, a key of the object mix's ``sizes``.
            x: metres.
            y: metres.
            yaw: heading, radians.
            size: length, width, height; drawn where absent.
            bottom: z of the label's bottom; where absent the object stands on the ground.
            force: put it even where it overlaps another.
        """
        size = size or draw_size(name, self.rng, self.object_mix.sizes)
        if not force and not (self.sees(x, y) and self.free(x, y, size[0], size[1], yaw)):
            return False
        z, along, across = self.ground.tilt(self.packed_ground, x, y, yaw, size[0], size[1])
        z = float(z) if bottom is None else bottom
        tilted = size[0] > 1.5 and bottom is None
        pitch, roll = (-math.atan(along), math.atan(across)) if tilted else (0.0, 0.0)
        shape = _BUILDERS[name](size, self.palette, self.rng)
        yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
        lean = rotation(yaw, pitch, roll)  # the box stays upright, about the middle of the leaning body
        box = (x + lean[0][2] * size[2] / 2, y + lean[1][2] * size[2] / 2, z + size[2] / 2, *size, yaw)
        self.placed.append(Placed(shape, (x, y, z), yaw, pitch, roll, name, box))
        self._occupy(x, y, size[0] / 2 + CLEARANCE, size[1] / 2 + CLEARANCE, yaw)
        distance = math.hypot(x, y)
        self._views.append((math.atan2(y, x), 0.4 * max(size[0], size[1]) / max(distance, 1.0), distance))
        return True

    def add_scenery(self, shape: Shape, x: float, y: float, yaw: float, gap: float = 0.15, sink: float = 0.0) -> bool:
        """Put scenery where nothing stands and, with ``guard``, where it hides no object; returns whether it fitted."""
        base = (shape.low[0], shape.high[0], shape.low[1], shape.high[1])
        if shape.low[2] < 0 and shape.high[2] > 3.5 and len(shape.parts) > 3 and shape.parts[0][6] < 12:
            base = (-0.4, 0.4, -0.4, 0.4)  # a tree stands on its trunk; its crown may hang over cars
        c, s = math.cos(yaw), math.sin(yaw)
        mx, my = (base[0] + base[1]) / 2, (base[2] + base[3]) / 2
        cx, cy = x + c * mx - s * my, y + s * mx + c * my
        length, width = base[1] - base[0], base[3] - base[2]
        if not self.free(cx, cy, length, width, yaw, gap):
            return False
        if self.guard and self._hides(cx, cy, length, width, yaw):
            return False
        z = ground_height(self.packed_ground, cx, cy) - sink
        self.placed.append(Placed(shape, (x, y, z), yaw))
        self._occupy(cx, cy, length / 2, width / 2, yaw)
        return True

    def _hides(self, x: float, y: float, length: float, width: float, yaw: float) -> bool:
        """Tell whether a footprint lies before the middle of an object that the layout says is seen."""
        c, s = math.cos(yaw), math.sin(yaw)
        corners = [
            (x + c * a - s * b, y + s * a + c * b) for a in (-length / 2, length / 2) for b in (-width / 2, width / 2)
        ]
        middle, near = math.atan2(y, x), min(math.hypot(*p) for p in corners)
        away = [math.remainder(math.atan2(q, p) - middle, math.tau) for p, q in corners]
        low, high = middle + min(away), middle + max(away)
        if high - low < 0.012:  # posts hide little
            return False
        return any(
            distance > near + 0.5 and low - half < azimuth < high + half for azimuth, half, distance in self._views
        )
