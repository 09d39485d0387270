"""Everything without a label: walls, houses, hedges, trees, bushes, poles, signs, bins, fences and guard rails."""

from __future__ import annotations

import math

import numpy as np

from beambox.simulate.materials import BARK, LEAVES, METAL, PANE, RETRO, Palette
from beambox.simulate.shapes import Plane, Shape, profile_planes, rotation

__all__ = ["bin_box", "bush", "fence", "hedge", "house", "pole", "post", "rail", "rubble", "tree", "wall"]


def wall(length: float, height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A straight garden wall along x."""
    shape = Shape()
    thick = rng.uniform(0.1, 0.2)
    shape.box((-length / 2, -thick, -1.0), (length / 2, thick, height), palette.facade())
    return shape


def house(length: float, depth: float, height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A house whose front stands at y = 0 and faces -y: windows, a door, a gabled or flat roof."""
    shape, plaster = Shape(), palette.facade()
    hx = length / 2
    shape.box((-hx, 0.0, -2.0), (hx, depth, height), plaster)
    if rng.random() < 0.6:
        ridge = height + rng.uniform(0.25, 0.5) * depth
        # A gable across y: the profile is drawn in x-z and its axes are swapped.
        gable = profile_planes([(-0.4, height), (depth + 0.4, height), (depth / 2, ridge)], [plaster] * 3)
        planes: list[Plane] = [(0.0, p[0], p[2], p[3], plaster) for p in gable]
        planes += [(1.0, 0.0, 0.0, hx, plaster), (-1.0, 0.0, 0.0, hx, plaster)]
        shape.convex(planes, (-hx, -0.4, height), (hx, depth + 0.4, ridge))
    step, wide = rng.uniform(2.0, 3.5), rng.uniform(0.8, 1.5)
    for floor in range(min(4, int(height // 2.8))):
        z = 0.9 + 2.8 * floor
        for k in range(int(length // step)):
            x = -hx + (k + 0.5) * step
            shape.patch((x - wide / 2, -0.01, z), (x + wide / 2, 0.01, z + 1.4), PANE)
    if rng.random() < 0.5:
        x = rng.uniform(-0.6, 0.6) * hx
        shape.box((x - 0.8, -rng.uniform(0.3, 1.2), -0.5), (x + 0.8, 0.0, rng.uniform(0.2, 2.4)), plaster)
    return shape


def hedge(length: float, height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A clipped hedge along x; beams enter its leaves."""
    shape = Shape()
    thick = rng.uniform(0.25, 0.6)
    shape.box((-length / 2, -thick, -0.5), (length / 2, thick, height), LEAVES, rng.uniform(4.0, 14.0))
    return shape


def bush(size: float, height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A loose bush of a few leafy balls."""
    shape = Shape()
    for _ in range(rng.integers(2, 5)):
        x, y = rng.uniform(-0.35, 0.35, 2) * size
        r = rng.uniform(0.3, 0.5) * size
        shape.ellipsoid(
            (x, y, height * 0.45), (r, r, height * rng.uniform(0.4, 0.55)), LEAVES, None, rng.uniform(2.0, 7.0)
        )
    return shape


def tree(height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A tree: trunk, a few boughs and a crown of leafy balls."""
    shape = Shape()
    radius = rng.uniform(0.08, 0.25)
    crown = rng.uniform(0.25, 0.45) * height
    shape.prism(0.0, 0.0, radius, -0.5, height * 0.7, BARK)
    for _ in range(3):
        a, reach = rng.uniform(0, math.tau), rng.uniform(0.8, 1.6)
        shape.limb((0.0, 0.0, crown * 0.8), (reach * math.cos(a), reach * math.sin(a), crown * 1.3), 0.06, BARK)
    spread = rng.uniform(0.22, 0.35) * height
    for _ in range(rng.integers(3, 6)):
        x, y = rng.uniform(-0.5, 0.5, 2) * spread
        z = rng.uniform(crown + 0.3 * spread, height - 0.4 * spread)
        r = rng.uniform(0.5, 0.8) * spread
        shape.ellipsoid((x, y, z), (r, r, r * rng.uniform(0.6, 1.0)), LEAVES, None, rng.uniform(0.5, 2.5))
    return shape


def pole(height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A lamp post, traffic light or signpost."""
    shape = Shape()
    radius = rng.uniform(0.03, 0.11)
    shape.prism(0.0, 0.0, radius, -0.5, height, METAL, 8)
    kind = rng.random()
    if kind < 0.4:
        z, half = min(height, rng.uniform(2.0, 3.2)), rng.uniform(0.2, 0.45)
        face = RETRO if rng.random() < 0.7 else METAL
        shape.box((-0.02 - radius, -half, z - 2 * half), (-radius, half, z), face)
    elif kind < 0.6 and height > 3.0:
        shape.box((-0.18, -0.16, 2.2), (0.18, 0.16, 3.1), METAL)
    elif height > 4.5:
        shape.limb((0.0, 0.0, height), (0.0, rng.uniform(-2, 2), height + 0.2), 0.06, METAL)
    return shape


def post(palette: Palette, rng: np.random.Generator) -> Shape:
    """A thing as slender as a person: bollard, parking meter, hydrant, trunk, young tree."""
    shape, height, radius = Shape(), rng.uniform(0.6, 2.4), rng.uniform(0.04, 0.24)
    stuff = (METAL, BARK, palette.facade(), palette.cloth())[rng.integers(4)]
    shape.prism(0.0, 0.0, radius, -0.3, height, stuff, 8)
    kind = rng.random()
    if kind < 0.35:  # a head or a box on top
        wide = radius + rng.uniform(0.02, 0.2)
        shape.box((-wide, -wide, height), (wide, wide, height + rng.uniform(0.15, 0.6)), stuff)
    elif kind < 0.6:  # leaves around it
        wide = rng.uniform(0.15, 0.45)
        middle = (0.0, 0.0, height * rng.uniform(0.4, 0.9))
        shape.ellipsoid(middle, (wide, wide, height * 0.4), LEAVES, None, rng.uniform(3, 12))
    return shape


def bin_box(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A bin, crate, cabinet or container."""
    shape = Shape()
    shape.box((-size[0] / 2, -size[1] / 2, 0.0), (size[0] / 2, size[1] / 2, size[2]), palette.facade())
    return shape


def fence(length: float, height: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A fence along x: posts and a mesh that lets many beams through."""
    shape = Shape()
    for k in range(int(length // 2.5) + 1):
        shape.prism(-length / 2 + 2.5 * k, 0.0, 0.05, -0.5, height, METAL, 4)
    shape.box((-length / 2, -0.02, 0.05), (length / 2, 0.02, height), METAL, rng.uniform(5.0, 30.0))
    return shape


def rail(length: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A guard rail along x."""
    shape = Shape()
    for k in range(int(length // 3.0) + 1):
        shape.prism(-length / 2 + 3.0 * k, 0.0, 0.06, -0.5, 0.7, METAL, 4)
    shape.box((-length / 2, -0.04, 0.45), (length / 2, 0.04, 0.75), METAL)
    return shape


def rubble(size: float, palette: Palette, rng: np.random.Generator) -> Shape:
    """A heap of earth, stones or bags: tilted ellipsoids and a block."""
    shape, stuff = Shape(), palette.facade()
    for _ in range(rng.integers(2, 5)):
        x, y = rng.uniform(-0.5, 0.5, 2) * size
        turn = rotation(*rng.uniform(-0.6, 0.6, 3))
        radii = tuple(rng.uniform(0.2, 0.6, 3) * size)
        shape.ellipsoid((x, y, radii[2] * 0.5), radii, stuff, turn)
    return shape
