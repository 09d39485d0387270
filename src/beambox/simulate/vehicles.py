"""Bodies of cars, vans, trucks, buses and trams: profiles, rounded ends, tumblehome, windows, wheels, lamps.

Every builder fills a box of the given length, width and height; mirrors stick out, as they do of KITTI's boxes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beambox.simulate.materials import AIR, DARK, GLASS, INSIDE, LIGHT, PANE, RETRO, RIM, TIRE, Palette
from beambox.simulate.shapes import Plane, Shape, profile_planes

__all__ = ["CAR_STYLES", "bus", "car", "trailer", "tram", "truck", "van"]


@dataclass(frozen=True)
class _Style:
    """Shares of the half-length (x) and the height (z) where a car's profile bends: (low, high) of a uniform draw."""

    cowl: tuple[float, float]
    """Foot of the windscreen."""
    rake: tuple[float, float]
    """Run of the windscreen for each metre of rise."""
    roof_rear: tuple[float, float]
    """Rear end of the roof, behind the middle."""
    tail: tuple[float, float]
    """Foot of the rear window, behind the middle."""
    belt: tuple[float, float]
    """Lower edge of the windows."""
    nose: tuple[float, float]
    """Front edge of the bonnet."""


FRONT_MARGIN, REAR_MARGIN, SIDE_MARGIN = (0.04, 0.15), (0.0, 0.07), (0.0, 0.08)
"""Gap between a car's body and its label's box, metres; KITTI's labels leave it, mostly at the nose."""

CAR_STYLES: dict[str, _Style] = {
    "hatchback": _Style((0.26, 0.42), (1.0, 1.6), (0.58, 0.78), (0.84, 0.95), (0.61, 0.69), (0.46, 0.54)),
    "saloon": _Style((0.18, 0.34), (1.2, 1.8), (0.20, 0.40), (0.56, 0.72), (0.62, 0.69), (0.46, 0.53)),
    "estate": _Style((0.20, 0.36), (1.2, 1.7), (0.71, 0.84), (0.88, 0.97), (0.61, 0.68), (0.46, 0.53)),
    "suv": _Style((0.26, 0.40), (0.8, 1.3), (0.66, 0.81), (0.86, 0.96), (0.61, 0.68), (0.52, 0.60)),
    "small": _Style((0.34, 0.54), (0.9, 1.4), (0.63, 0.80), (0.86, 0.96), (0.59, 0.67), (0.47, 0.57)),
    "minivan": _Style((0.42, 0.58), (0.9, 1.3), (0.74, 0.87), (0.90, 0.98), (0.56, 0.64), (0.46, 0.55)),
}


def _style_of(length: float, height: float, rng: np.random.Generator) -> _Style:
    if height > 1.68:
        names = ["suv", "minivan"]
    elif length < 3.75:
        names = ["small", "small", "hatchback"]
    elif length > 4.35:
        names = ["saloon", "estate", "saloon", "suv"]
    else:
        names = ["hatchback", "hatchback", "saloon", "estate", "minivan"]
    return CAR_STYLES[names[rng.integers(len(names))]]


def _hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Convex hull, counter-clockwise."""
    ordered = sorted(set(points))

    def half(sequence: list[tuple[float, float]]) -> list[tuple[float, float]]:
        chain: list[tuple[float, float]] = []
        for p in sequence:
            while len(chain) > 1:
                (ax, az), (bx, bz) = chain[-2], chain[-1]
                if (bx - ax) * (p[1] - az) - (bz - az) * (p[0] - ax) > 1e-12:
                    break
                chain.pop()
            chain.append(p)
        return chain[:-1]

    return half(ordered) + half(ordered[::-1])


def _plan_planes(
    hx: float, hy: float, radius: tuple[float, float], bow: tuple[float, float], paint: int
) -> list[Plane]:
    """Upright half-spaces that round the corners and bow the ends of a body; (front, rear) of each."""
    planes: list[Plane] = []
    for end, r, b in ((1.0, radius[0], bow[0]), (-1.0, radius[1], bow[1])):
        for degrees in (25, 45, 65, 80):
            c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            reach = (hx - r) * c + (hy - r) * s + r
            planes += [(end * c, s, 0.0, reach, paint), (end * c, -s, 0.0, reach, paint)]
        c, s = math.cos(b), math.sin(b)
        reach = hx * c + 0.3 * hy * s
        planes += [(end * c, s, 0.0, reach, paint), (end * c, -s, 0.0, reach, paint)]
        c, s = math.sin(0.05), math.cos(0.05)  # the flanks draw in towards the ends
        reach = 0.4 * hx * c + hy * s
        planes += [(end * c, s, 0.0, reach, paint), (end * c, -s, 0.0, reach, paint)]
    return planes


def _side(y0: float, z0: float, y1: float, z1: float, material: int) -> list[Plane]:
    """The left and right half-space through (y0, z0) below and (y1, z1) above."""
    dy, dz = y1 - y0, z1 - z0
    length = math.hypot(dy, dz)
    ny, nz = dz / length, -dy / length
    return [(0.0, ny, nz, ny * y0 + nz * z0, material), (0.0, -ny, nz, ny * y0 + nz * z0, material)]


def _wheels(shape: Shape, axles: tuple[float, ...], hy: float, radius: float, width: float = 0.2) -> None:
    for x in axles:
        for side in (1.0, -1.0):
            shape.wheel(x, side * (hy - width / 2 - 0.01), radius, width, (TIRE, RIM))


def _lamps(shape: Shape, hx: float, hy: float, h: float, rng: np.random.Generator, rear_height: float) -> None:
    """Number plates, headlamps and rear lamps: patches on the hull."""
    for end, z in ((1.0, rng.uniform(0.24, 0.33) * h), (-1.0, rng.uniform(0.32, 0.58) * h)):
        x0, x1 = sorted((end * hx * 1.05, end * (hx - 0.15)))
        shape.patch((x0, -0.26, z - 0.06), (x1, 0.26, z + 0.06), RETRO)
    front, rear = rng.uniform(0.38, 0.46) * h, rear_height + rng.uniform(-0.06, 0.02) * h
    for side in (1.0, -1.0):
        y0, y1 = sorted((side * hy * 1.02, side * hy * rng.uniform(0.55, 0.7)))
        shape.patch((hx - 0.45, y0, front - 0.07), (hx * 1.05, y1, front + 0.08), LIGHT)
        y0, y1 = sorted((side * hy * 1.02, side * hy * rng.uniform(0.6, 0.78)))
        tall = rng.uniform(0.06, 0.16)
        shape.patch(
            (-hx * 1.05, y0, rear - tall), (-hx + 0.25, y1, rear + tall), RETRO if rng.random() < 0.6 else LIGHT
        )


def _seats(shape: Shape, x_front: float, x_rear: float, hy: float, h: float, rng: np.random.Generator) -> None:
    for side in (1.0, -1.0):
        y = side * hy * 0.42
        shape.box((x_front - 0.14, y - 0.23, 0.28 * h), (x_front + 0.02, y + 0.23, 0.70 * h), INSIDE)
        shape.box((x_front - 0.15, y - 0.12, 0.70 * h), (x_front - 0.05, y + 0.12, 0.82 * h), INSIDE)
        shape.box((x_front, y - 0.24, 0.24 * h), (x_front + 0.45, y + 0.24, 0.38 * h), INSIDE)
        if x_rear < x_front - 0.5:
            shape.box((x_rear - 0.16, y - 0.12, 0.62 * h), (x_rear - 0.06, y + 0.12, 0.76 * h), INSIDE)
    if x_rear < x_front - 0.5:
        shape.box((x_rear - 0.18, -hy * 0.75, 0.28 * h), (x_rear, hy * 0.75, 0.63 * h), INSIDE)
    if rng.random() < 0.35:
        shape.ellipsoid((x_front + 0.12, hy * 0.42, 0.60 * h), (0.13, 0.22, 0.22 * h), INSIDE)
        shape.ellipsoid((x_front + 0.12, hy * 0.42, 0.83 * h), (0.11, 0.10, 0.13), INSIDE)


def _greenhouse(
    shape: Shape, outline: list[tuple[float, float]], hy: tuple[float, float], paint: int, sides: int, tail: int
) -> None:
    """The part above the belt: a shell of glass, a roof slab and three pairs of pillars.

    Args:
        shape: gets the parts.
        outline: foot of the rear window, foot and top of the windscreen, ridge of the roof, end of the roof.
        hy: half-width at the belt and at the roof.
        paint: material of roof and pillars.
        sides: material of the rear side windows' planes.
        tail: material of the rear window.
    """
    (x_tail, belt), (x_cowl, _), (x_front, _), (_, top), (x_rear, z_rear) = outline
    profile = profile_planes(outline, (AIR, GLASS, paint, paint, tail))
    flanks = _side(hy[0], belt, hy[1], top, sides)
    planes = profile + flanks
    low, high = (x_tail, -hy[0], belt), (x_cowl, hy[0], top)
    shape.convex(planes, low, high)
    solid = [(*p[:4], paint) for p in planes]
    screen, back = profile[1], profile[4]
    roof_low = min(z_rear, outline[2][1]) - 0.05
    wide = hy[1] + 0.1
    shape.convex(
        [*solid, (0.0, 0.0, -1.0, -roof_low, INSIDE)], (x_rear - 0.15, -wide, roof_low), (x_front + 0.15, wide, top)
    )
    middle = 0.5 * (x_front + x_rear) + 0.12 * (x_front - x_rear)
    posts: list[tuple[list[Plane], float, float]] = [
        ([(-screen[0], 0.0, -screen[2], 0.09 - screen[3], INSIDE)], x_front - 0.15, x_cowl),
        (
            [(1.0, 0.0, 0.0, middle + 0.05, INSIDE), (-1.0, 0.0, 0.0, 0.05 - middle, INSIDE)],
            middle - 0.05,
            middle + 0.05,
        ),
        ([(-back[0], 0.0, -back[2], max(0.12, 0.08 * (x_cowl - x_tail)) - back[3], INSIDE)], x_tail, x_rear + 0.35),
    ]
    for extra, x0, x1 in posts:
        for k, side in ((0, 1.0), (1, -1.0)):
            flank = flanks[k]
            inner: Plane = (0.0, -flank[1], -flank[2], 0.06 - flank[3], INSIDE)
            y0, y1 = sorted((side * (hy[1] - 0.15), side * hy[0]))
            shape.convex([*solid, *extra, inner], (x0, y0, belt), (x1, y1, top))


def car(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A passenger car of (length, width, height) metres in one of :data:`CAR_STYLES`."""
    length, width, h = size
    shape, style, paint = Shape(), _style_of(length, h, rng), palette.paint()
    front, rear, side = rng.uniform(*FRONT_MARGIN), rng.uniform(*REAR_MARGIN), rng.uniform(*SIDE_MARGIN)
    hx, hy = (length - front - rear) / 2, width / 2 - side
    top = h - rng.uniform(0.0, 0.07)
    belt, nose = rng.uniform(*style.belt) * h, rng.uniform(*style.nose) * h
    clear = rng.uniform(0.08, 0.14) * h
    x_cowl, x_tail = rng.uniform(*style.cowl) * hx, -rng.uniform(*style.tail) * hx
    x_front = x_cowl - rng.uniform(*style.rake) * (0.94 * top - belt)
    x_rear = min(-rng.uniform(*style.roof_rear) * hx, x_front - 0.5)
    x_tail = min(x_tail, x_rear - 0.05)
    outline = _hull([
        (-hx * 0.94, clear), (hx * 0.93, clear), (hx, 0.24 * h), (hx * 0.998, 0.36 * h),
        (hx * rng.uniform(0.93, 0.97), nose), (x_cowl, belt + 0.02), (x_tail, belt + 0.02),
        (-hx * rng.uniform(0.965, 0.985), belt - rng.uniform(0.0, 0.04) * h), (-hx, 0.45 * h), (-hx, 0.26 * h),
    ])  # fmt: skip
    radius = (rng.uniform(0.3, 0.5), rng.uniform(0.22, 0.42))
    hull = profile_planes(outline, [paint] * len(outline))
    hull += _side(hy, 0.45 * h, hy * 0.965, belt, paint) + _side(hy * 0.955, clear, hy, 0.32 * h, paint)
    hull += [(0.0, 1.0, 0.0, hy, paint), (0.0, -1.0, 0.0, hy, paint)]
    hull += _plan_planes(hx, hy, radius, (rng.uniform(0.1, 0.2), rng.uniform(0.06, 0.16)), paint)
    # The hull without its passenger room: engine, boot, doors and floor, so that beams through a window find seats.
    boot = min(x_tail + 0.35, x_rear + 0.2) if x_tail < -0.8 * hx else x_tail + 0.1
    shape.convex([*hull, (-1.0, 0.0, 0.0, -x_cowl + 0.15, INSIDE)], (x_cowl - 0.15, -hy, clear), (hx, hy, belt + 0.02))
    shape.convex([*hull, (1.0, 0.0, 0.0, boot, INSIDE)], (-hx, -hy, clear), (boot, hy, belt + 0.02))
    shape.convex([*hull, (0.0, -1.0, 0.0, 0.12 - hy, INSIDE)], (-hx, hy - 0.12, clear), (hx, hy, belt + 0.02))
    shape.convex([*hull, (0.0, 1.0, 0.0, 0.12 - hy, INSIDE)], (-hx, -hy, clear), (hx, 0.12 - hy, belt + 0.02))
    shape.convex([*hull, (0.0, 0.0, 1.0, 0.28 * h, INSIDE)], (-hx, -hy, clear), (hx, hy, 0.28 * h))
    glasshouse = [(x_tail, belt), (x_cowl, belt), (x_front, 0.965 * top), ((x_front + x_rear) / 2, top),
                  (x_rear, rng.uniform(0.945, 0.985) * top)]  # fmt: skip
    dark_tail = PANE if rng.random() < 0.25 else GLASS
    _greenhouse(shape, glasshouse, (hy * 0.955, hy * rng.uniform(0.68, 0.8)), paint, GLASS, dark_tail)
    _seats(shape, min(x_front, -rng.uniform(0.12, 0.26) * hx), -rng.uniform(0.48, 0.58) * hx, hy, h, rng)
    _wheels(
        shape,
        (rng.uniform(0.58, 0.66) * hx, -rng.uniform(0.56, 0.66) * hx),
        hy,
        rng.uniform(0.29, 0.34) * min(1, h / 1.5),
    )
    _lamps(shape, hx, hy, h, rng, 0.92 * belt)
    for side in (1.0, -1.0):
        shape.ellipsoid((x_cowl - 0.22, side * (hy + 0.06), belt + 0.06), (0.07, 0.11, 0.075), paint)
    shape.move_forward((rear - front) / 2)
    return shape


def van(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A delivery van or minibus: short nose, tall box, few windows."""
    length, width, h = size
    shape, paint = Shape(), palette.paint()
    hx, hy = length / 2, width / 2
    clear, belt = rng.uniform(0.09, 0.13) * h, rng.uniform(0.50, 0.58) * h
    x_cowl = hx - rng.uniform(0.35, 0.9)
    x_screen = x_cowl - rng.uniform(0.3, 0.7)
    flat: list[Plane] = [(0.0, 1.0, 0.0, hy, paint), (0.0, -1.0, 0.0, hy, paint)]
    ends = _plan_planes(hx, hy, (0.25, 0.12), (0.12, 0.02), paint)
    nose = _hull([(-hx, clear), (hx * 0.95, clear), (hx, 0.2 * h), (hx * 0.99, 0.36 * h), (x_cowl, belt), (-hx, belt)])
    shape.convex(profile_planes(nose, [paint] * len(nose)) + flat + ends, (-hx, -hy, clear), (hx, hy, belt))
    upper = [(-hx, belt - 0.1), (x_cowl + 0.08, belt - 0.1), (x_screen, 0.93 * h), (x_screen - 0.35, h),
             (-hx * 0.95, 0.99 * h), (-hx * 0.985, 0.94 * h)]  # fmt: skip
    flanks = _side(hy * 0.99, belt - 0.1, hy * rng.uniform(0.86, 0.94), h, paint)
    materials = [paint, PANE, paint, paint, paint, paint]
    shape.convex(profile_planes(upper, materials) + flanks + ends, (-hx, -hy, belt - 0.1), (x_cowl + 0.08, hy, h))
    glazed = x_screen - 0.9 if rng.random() < 0.6 else -hx * 0.9
    for side in (1.0, -1.0):
        y0, y1 = sorted((side * hy * 1.01, side * hy * 0.8))
        shape.patch((glazed, y0, belt + 0.05), (x_cowl - 0.1, y1, 0.85 * h), PANE)
        shape.ellipsoid((x_cowl - 0.1, side * (hy + 0.1), belt + 0.15), (0.07, 0.12, 0.16), DARK)
    if rng.random() < 0.6:
        shape.patch((-hx * 1.01, -hy * 0.8, belt + 0.1), (-hx + 0.2, hy * 0.8, 0.85 * h), PANE)
    _wheels(shape, (hx * 0.66, -hx * 0.6), hy, 0.33)
    _lamps(shape, hx, hy, min(h, 1.9), rng, 0.45 * h)
    return shape


def truck(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A lorry: cab, load and chassis."""
    length, width, h = size
    shape, paint, load = Shape(), palette.paint(), palette.facade()
    hx, hy = length / 2, width / 2
    cab = min(rng.uniform(1.6, 2.3), 0.4 * length)
    roof = h * rng.uniform(0.72, 1.0)
    front = _hull([(hx - cab, 0.45), (hx, 0.45), (hx, 0.5 * roof), (hx - 0.25, roof), (hx - cab, roof)])
    flat: list[Plane] = [(0.0, 1.0, 0.0, hy * 0.96, paint), (0.0, -1.0, 0.0, hy * 0.96, paint)]
    shape.convex(profile_planes(front, [paint] * len(front)) + flat, (hx - cab, -hy, 0.45), (hx, hy, roof))
    shape.box((-hx, -hy, rng.uniform(0.8, 1.15)), (hx - cab - 0.15, hy, h), load)
    shape.box((-hx, -0.45, 0.55), (hx - 0.2, 0.45, 1.0), DARK)
    shape.patch((hx - 0.5, -hy * 0.85, 0.52 * roof), (hx * 1.01, hy * 0.85, 0.85 * roof), PANE)
    for side in (1.0, -1.0):
        y0, y1 = sorted((side * hy, side * hy * 0.9))
        shape.patch((hx - cab * 0.7, y0, 0.52 * roof), (hx - 0.2, y1, 0.85 * roof), PANE)
    _wheels(shape, (hx - 1.2, -hx + 1.3) if length < 7.5 else (hx - 1.2, -hx + 1.2, -hx + 2.4), hy * 0.98, 0.48, 0.3)
    _lamps(shape, hx, hy, 1.8, rng, 0.9)
    return shape


def bus(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A city bus or coach: a long box on wheels, glass in front, a band of windows, doors on the right."""
    length, width, h = size
    shape, paint = Shape(), palette.paint()
    hx, hy = length / 2, width / 2
    clear, belt = rng.uniform(0.22, 0.34), rng.uniform(0.32, 0.45) * h
    slant = rng.uniform(0.05, 0.35)
    outline = _hull([
        (-hx, clear), (hx * 0.99, clear), (hx, 0.3 * h), (hx - slant, 0.95 * h), (hx - slant - 0.15, h),
        (-hx + 0.12, h), (-hx, 0.95 * h),
    ])  # fmt: skip
    ends = _plan_planes(hx, hy, (0.3, 0.15), (0.06, 0.02), paint)
    flat: list[Plane] = [(0.0, 1.0, 0.0, hy, paint), (0.0, -1.0, 0.0, hy, paint)]
    flat += _side(hy, 0.8 * h, hy * 0.97, h, paint)
    shape.convex(profile_planes(outline, [paint] * len(outline)) + flat + ends, (-hx, -hy, clear), (hx, hy, h))
    top = rng.uniform(0.78, 0.88) * h
    shape.patch((hx - slant - 0.3, -hy * 0.9, belt * 0.9), (hx * 1.01, hy * 0.9, top), PANE)
    for side in (1.0, -1.0):
        y0, y1 = sorted((side * hy * 1.01, side * hy * 0.9))
        shape.patch((-hx * 0.95, y0, belt), (hx - 0.6, y1, top), PANE)
        shape.ellipsoid((hx - 0.15, side * (hy + 0.12), 0.6 * h), (0.09, 0.13, 0.2), DARK)
    for x in (hx * 0.8, -0.05 * hx):
        shape.patch((x - 0.6, -hy * 1.01, clear), (x + 0.6, -hy * 0.9, top), PANE)
    if rng.random() < 0.7:
        shape.patch((-hx * 1.01, -hy * 0.8, belt), (-hx + 0.2, hy * 0.8, top), PANE)
    shape.box((-hx * 0.9, -hy * 0.85, 0.15), (hx * 0.9, hy * 0.85, clear), DARK)
    _wheels(shape, (hx - min(2.6, 0.28 * length), -hx + min(3.2, 0.3 * length)), hy, 0.48, 0.3)
    _lamps(shape, hx, hy, 1.9, rng, 1.0)
    return shape


def tram(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A tram: a long box with a band of windows."""
    length, width, h = size
    shape, paint = Shape(), palette.paint()
    hx, hy = length / 2, width / 2
    ends = _plan_planes(hx, hy, (0.5, 0.5), (0.1, 0.1), paint)
    box: list[Plane] = [(0.0, 1.0, 0.0, hy, paint), (0.0, -1.0, 0.0, hy, paint), (0.0, 0.0, 1.0, h, paint),
                        (0.0, 0.0, -1.0, -0.3, DARK), (1.0, 0.0, 0.0, hx, paint),
                        (-1.0, 0.0, 0.0, hx, paint)]  # fmt: skip
    shape.convex(box + ends, (-hx, -hy, 0.3), (hx, hy, h))
    low = rng.uniform(0.35, 0.45) * h
    shape.patch((-hx, -hy, low), (hx, hy, rng.uniform(0.7, 0.8) * h), PANE)
    shape.box((-hx * 0.9, -hy * 0.8, 0.05), (hx * 0.9, hy * 0.8, 0.3), DARK)
    return shape


def trailer(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A parked trailer or caravan."""
    length, width, h = size
    shape, paint = Shape(), palette.paint()
    hx, hy, floor = length / 2, width / 2, rng.uniform(0.35, 0.6)
    body = hx - min(1.1, 0.4 * hx)
    shape.box((-hx, -hy, floor), (body, hy, h), paint)
    shape.limb((body, 0.0, floor), (hx - 0.05, 0.0, floor - 0.05), 0.05, DARK)
    _wheels(shape, (-0.1 * hx,), hy * 0.98, min(0.3, floor * 0.7))
    if rng.random() < 0.5 and h > 1.5:
        shape.patch((-hx * 0.6, -hy * 1.01, 0.6 * h), (body * 0.6, hy * 1.01, 0.85 * h), PANE)
    return shape
