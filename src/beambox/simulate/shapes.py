"""Shapes made of convex parts: half-space sets and ellipsoids, in their own frame (x forward, z up from the ground)."""

from __future__ import annotations

import math
from collections.abc import Sequence

__all__ = ["Plane", "Shape", "profile_planes", "rotation"]

Plane = tuple[float, float, float, float, int]
"""Outward unit normal x, y, z, distance, material: inside is ``normal . point <= distance``."""
Vector = tuple[float, float, float]


class Shape:
    """A rigid object: convex parts, patches of other material, and how far it reaches."""

    def __init__(self) -> None:
        self.planes: list[Plane] = []
        self.ellipsoids: list[tuple[float, ...]] = []  # 9 numbers: rows of the matrix that makes it a unit sphere
        self.parts: list[tuple[float, ...]] = []  # is_ellipsoid, first, last, x, y, z, radius, density, material
        self.patches: list[tuple[float, ...]] = []  # x0, x1, y0, y1, z0, z1, material
        self.low: list[float] = [math.inf] * 3
        self.high: list[float] = [-math.inf] * 3

    def _reach(self, low: Sequence[float], high: Sequence[float]) -> tuple[float, float, float, float]:
        for k in range(3):
            self.low[k] = min(self.low[k], low[k])
            self.high[k] = max(self.high[k], high[k])
        center = [(a + b) / 2 for a, b in zip(low, high)]
        return center[0], center[1], center[2], math.dist(low, high) / 2

    def convex(self, planes: Sequence[Plane], low: Vector, high: Vector, density: float = 0.0) -> None:
        """Add the common inside of half-spaces, which must lie between the corners ``low`` and ``high``.

        Args:
            planes: at least those that close the part.
            low: smallest x, y, z reached, metres.
            high: largest x, y, z reached, metres.
            density: returns a metre of path inside a leafy part; 0 for a solid one.
        """
        first = len(self.planes)
        self.planes.extend(planes)
        sphere = self._reach(low, high)
        self.parts.append((0.0, first, len(self.planes), *sphere, density, planes[0][4]))

    def box(self, low: Vector, high: Vector, material: int, density: float = 0.0) -> None:
        """Add a box between two corners."""
        planes: list[Plane] = []
        for k in range(3):
            unit = [0.0, 0.0, 0.0]
            unit[k] = 1.0
            planes.append((unit[0], unit[1], unit[2], high[k], material))
            planes.append((-unit[0], -unit[1], -unit[2], -low[k], material))
        self.convex(planes, low, high, density)

    def prism(self, x: float, y: float, radius: float, low: float, high: float, material: int, sides: int = 8) -> None:
        """Add an upright post with a regular polygon as its section."""
        inner = radius * math.cos(math.pi / sides)
        planes: list[Plane] = [(0.0, 0.0, 1.0, high, material), (0.0, 0.0, -1.0, -low, material)]
        for k in range(sides):
            c, s = math.cos(2 * math.pi * k / sides), math.sin(2 * math.pi * k / sides)
            planes.append((c, s, 0.0, inner + c * x + s * y, material))
        self.convex(planes, (x - radius, y - radius, low), (x + radius, y + radius, high))

    def wheel(self, x: float, y: float, radius: float, width: float, materials: tuple[int, int]) -> None:
        """Add a wheel that stands on the ground; materials of tyre and rim."""
        tire, rim = materials
        planes: list[Plane] = [(0.0, 1.0, 0.0, y + width / 2, rim), (0.0, -1.0, 0.0, width / 2 - y, rim)]
        for k in range(10):
            c, s = math.cos(2 * math.pi * k / 10), math.sin(2 * math.pi * k / 10)
            planes.append((c, 0.0, s, radius * 0.98 + c * x + s * radius, tire))
        self.convex(planes, (x - radius, y - width / 2, 0.0), (x + radius, y + width / 2, 2 * radius))

    def ellipsoid(
        self,
        center: Vector,
        radii: Vector,
        material: int,
        turn: Sequence[Sequence[float]] | None = None,
        density: float = 0.0,
    ) -> None:
        """Add an ellipsoid; ``turn`` holds its axes as columns (see :func:`rotation`)."""
        axes = turn or ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        matrix = [axes[j][i] / radii[i] for i in range(3) for j in range(3)]
        reach = [math.sqrt(sum((axes[j][i] * radii[i]) ** 2 for i in range(3))) for j in range(3)]
        low, high = ([c + k * r for c, r in zip(center, reach)] for k in (-1, 1))
        self._reach(low, high)
        index = len(self.ellipsoids)
        self.ellipsoids.append(tuple(matrix))
        self.parts.append((1.0, index, index + 1, *center, max(radii), density, material))

    def limb(self, start: Vector, end: Vector, radius: float, material: int) -> None:
        """Add a slender ellipsoid from one joint to another."""
        along = [b - a for a, b in zip(start, end)]
        length = math.hypot(*along) or 1e-6
        w = [v / length for v in along]
        helper = (1.0, 0.0, 0.0) if abs(w[0]) < 0.9 else (0.0, 1.0, 0.0)
        u = [
            w[1] * helper[2] - w[2] * helper[1],
            w[2] * helper[0] - w[0] * helper[2],
            w[0] * helper[1] - w[1] * helper[0],
        ]
        norm = math.hypot(*u)
        u = [v / norm for v in u]
        v = [w[1] * u[2] - w[2] * u[1], w[2] * u[0] - w[0] * u[2], w[0] * u[1] - w[1] * u[0]]
        center = tuple((a + b) / 2 for a, b in zip(start, end))
        self.ellipsoid(center, (radius, radius, length / 2 + radius), material, list(zip(u, v, w)))  # type: ignore[arg-type]

    def move_forward(self, distance: float) -> None:
        """Shift everything added so far along x, metres."""
        self.planes = [(*p[:3], p[3] + p[0] * distance, p[4]) for p in self.planes]
        self.parts = [(*p[:3], p[3] + distance, *p[4:]) for p in self.parts]
        self.patches = [(p[0] + distance, p[1] + distance, *p[2:]) for p in self.patches]
        self.low[0] += distance
        self.high[0] += distance

    def patch(self, low: Vector, high: Vector, material: int) -> None:
        """Give another material to whatever surface lies between two corners."""
        self.patches.append((low[0], high[0], low[1], high[1], low[2], high[2], material))


def rotation(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> list[list[float]]:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll), rows first; its columns are the turned axes."""
    cy, sy, cp, sp, cr, sr = (
        math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll),
    )  # fmt: skip
    return [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]


def profile_planes(outline: Sequence[tuple[float, float]], materials: Sequence[int]) -> list[Plane]:
    """Half-spaces of a convex, counter-clockwise outline in x-z; each edge's material goes by its first corner."""
    planes: list[Plane] = []
    for k, (x, z) in enumerate(outline):
        nx, nz = outline[(k + 1) % len(outline)]
        dx, dz = nx - x, nz - z
        length = math.hypot(dx, dz)
        if length > 1e-6:
            planes.append((dz / length, 0.0, -dx / length, (dz * x - dx * z) / length, materials[k]))
    return planes
