"""People on foot and on bicycles, made of ellipsoids for trunk, head and limbs."""

from __future__ import annotations

import math

import numpy as np

from beambox.simulate.materials import METAL, SKIN, TIRE, Palette
from beambox.simulate.shapes import Shape, rotation

__all__ = ["cyclist", "pedestrian", "sitting"]


def pedestrian(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A standing or walking person within (length, width, height): the stride spans the length, the arms the width."""
    length, width, h = size
    h -= rng.uniform(0.0, 0.12)  # annotators leave a margin
    shape, top, trousers = Shape(), palette.cloth(), palette.cloth()
    hx, hy = length / 2, width / 2
    stride = max(hx - 0.13, 0.02) * rng.uniform(0.7, 1.0)
    shoulder = max(hy - 0.07, 0.12)
    for side in (1.0, -1.0):
        hip, foot = (0.0, side * 0.09, 0.50 * h), (side * stride, side * 0.10, 0.03 * h)
        knee = (0.5 * foot[0] + 0.04, side * 0.1, 0.27 * h)
        shape.limb(hip, knee, 0.075, trousers)
        shape.limb(knee, foot, 0.055, trousers)
        shape.ellipsoid((foot[0] + 0.06, foot[1], 0.04), (0.13, 0.05, 0.045), TIRE)
        elbow = (-side * stride * 0.4, side * shoulder, 0.62 * h)
        shape.limb((0.0, side * shoulder * 0.85, 0.81 * h), elbow, 0.05, top)
        shape.limb(elbow, (-side * stride * 0.7 + 0.08, side * shoulder * 0.95, 0.47 * h), 0.04, top)
    shape.ellipsoid((0.0, 0.0, 0.66 * h), (0.13, max(0.16, shoulder * 0.8), 0.18 * h), top)
    shape.ellipsoid((0.0, 0.0, 0.52 * h), (0.12, 0.16, 0.09 * h), trousers)
    shape.ellipsoid((0.01, 0.0, h - 0.125), (0.10, 0.085, 0.125), SKIN)
    if rng.random() < 0.25:
        side = 1.0 if rng.random() < 0.5 else -1.0
        shape.ellipsoid((-0.05, side * shoulder, 0.35 * h), (0.16, 0.06, 0.15), palette.cloth())
    elif rng.random() < 0.25:
        shape.ellipsoid((-0.17, 0.0, 0.70 * h), (0.10, 0.15, 0.14 * h), palette.cloth())
    return shape


def sitting(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A person on a chair or bench."""
    length, width, h = size
    shape, top, trousers = Shape(), palette.cloth(), palette.cloth()
    hx, hy, seat = length / 2, width / 2, 0.36 * h
    for side in (1.0, -1.0):
        knee = (hx - 0.12, side * 0.12, seat + 0.02)
        shape.limb((-hx + 0.2, side * 0.1, seat), knee, 0.08, trousers)
        shape.limb(knee, (hx - 0.1 - rng.uniform(0, 0.1), side * 0.12, 0.05), 0.06, trousers)
        shape.limb((-hx + 0.15, side * (hy - 0.08), 0.75 * h), (hx * 0.2, side * (hy - 0.1), 0.5 * h), 0.05, top)
    shape.ellipsoid((-hx + 0.17, 0.0, 0.62 * h), (0.14, max(hy - 0.1, 0.15), 0.24 * h), top)
    shape.ellipsoid((-hx + 0.2, 0.0, h - 0.12), (0.1, 0.085, 0.12), SKIN)
    return shape


def cyclist(size: tuple[float, float, float], palette: Palette, rng: np.random.Generator) -> Shape:
    """A rider on a bicycle; the wheels let most beams pass between their spokes."""
    length, width, h = size
    h -= rng.uniform(0.02, 0.18)  # annotators leave a margin
    shape, top, trousers = Shape(), palette.cloth(), palette.cloth()
    hx, hy = length / 2 - rng.uniform(0.0, 0.08), width / 2
    wheel = min(0.34, hx * 0.42)
    axle = hx - wheel
    for x in (axle, -axle):
        turn = rotation(rng.uniform(-0.2, 0.2) if x > 0 else 0.0)
        shape.ellipsoid((x, 0.0, wheel), (wheel, 0.02, wheel), TIRE, turn, density=5.0)
        for k in range(8):
            a, b = math.tau * k / 8, math.tau * (k + 1) / 8
            rim = wheel - 0.02
            start = (x + rim * math.cos(a), 0.0, wheel + rim * math.sin(a))
            shape.limb(start, (x + rim * math.cos(b), 0.0, wheel + rim * math.sin(b)), 0.018, TIRE)
    bar, saddle, crank = (axle * 0.72, 0.0, 0.58 * h), (-axle * 0.4, 0.0, 0.53 * h), (-0.02, 0.0, 0.29)
    for start, end in (((axle, 0.0, wheel), bar), (bar, crank), (crank, saddle), (saddle, (-axle, 0.0, wheel)),
                       (saddle, bar)):  # fmt: skip
        shape.limb(start, end, 0.022, METAL)
    grip = max(hy - 0.06, 0.18)
    shape.limb((bar[0], -grip, bar[2] + 0.04), (bar[0], grip, bar[2] + 0.04), 0.02, METAL)
    lean = rng.uniform(0.1, 0.4)
    neck = (saddle[0] + lean * 1.4, 0.0, 0.86 * h)
    shape.ellipsoid((neck[0] + 0.08, 0.0, h - 0.125), (0.11, 0.09, 0.125), SKIN)
    for side in (1.0, -1.0):  # the back: broader than deep
        shape.limb((saddle[0], side * 0.05, saddle[2] + 0.05), (neck[0], side * 0.11, neck[2]), 0.13, top)
    for side in (1.0, -1.0):
        shape.limb((neck[0], side * 0.17, neck[2] - 0.06), (bar[0], side * grip, bar[2] + 0.05), 0.045, top)
        pedal = (crank[0] + side * 0.16, side * 0.1, crank[2] - side * 0.05)
        knee = (saddle[0] + 0.36, side * 0.11, 0.45 * h - side * 0.04)
        shape.limb((saddle[0], side * 0.09, saddle[2]), knee, 0.075, trousers)
        shape.limb(knee, pedal, 0.055, trousers)
    return shape
