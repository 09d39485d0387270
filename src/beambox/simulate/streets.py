"""Random streets: roads, traffic, parked cars, people; and the scenery along a road."""

from __future__ import annotations

import math

import numpy as np

from beambox.simulate import scenery
from beambox.simulate.ground import Ground, Road
from beambox.simulate.object_mix import draw_size
from beambox.simulate.stage import Stage

__all__ = ["add_scenery", "random_ground", "random_street"]

_REACH = 78.0  # metres; nothing is put farther away


def random_ground(roads: tuple[Road, ...], rng: np.random.Generator, height: float) -> Ground:
    """A ground as KITTI's scans show it: it rises by about 0.85 % ahead (the sensor's pitch) and bends.

    Args:
        roads: the roads.
        rng: source of the choices.
        height: of the sensor, metres.
    """
    count = 4
    amplitude, length = rng.uniform(0.002, 0.03, count), rng.uniform(6.0, 40.0, count)
    angle, phase = rng.uniform(0, math.tau, count), rng.uniform(0, math.tau, count)
    wave = math.tau / length
    waves = np.stack((amplitude, wave * np.cos(angle), wave * np.sin(angle), phase), axis=1)
    return Ground(
        height=-height + rng.normal(-0.05, 0.03),
        slope=(rng.normal(0.0080, 0.005), rng.normal(0.0, 0.010)),
        bend=(rng.normal(0.0, 0.00025), rng.normal(0.0, 0.00025)),
        waves=waves,
        roads=roads,
        crown=rng.uniform(0.0, 0.06),
        bank=rng.choice([0.0, 0.0, rng.uniform(-0.1, 0.25)]),
        bank_limit=rng.uniform(0.2, 2.0),
        roughness=(rng.uniform(0.001, 0.006), rng.uniform(0.002, 0.008), rng.uniform(0.01, 0.08)),
    )


class _Line:
    """Places along a road: u metres along it, s metres to the left of its centre line."""

    def __init__(self, road: Road) -> None:
        self.road = road

    def at(self, u: float, s: float) -> tuple[float, float, float]:
        """x, y and the road's direction there."""
        road = self.road
        across = road.offset + s + 0.5 * road.bend * u * u
        c, sn = math.cos(road.angle), math.sin(road.angle)
        return c * u - sn * across, sn * u + c * across, road.angle + math.atan(road.bend * u)


def _parked(stage: Stage, line: _Line, side: float, fill: float, across: bool) -> None:
    """A row of parked cars along a kerb; ``across`` parks them at right angles to it."""
    rng, road = stage.rng, line.road
    u = stage.ahead + rng.uniform(-4, 6)
    inset = rng.uniform(0.1, 0.5) if rng.random() < 0.75 else -rng.uniform(0.2, 1.2)
    while u < _REACH:
        name = str(rng.choice(stage.object_mix.parked))
        size = draw_size(name, rng, stage.object_mix.sizes)
        along = size[1] if across else size[0]
        u += along / 2
        if rng.random() < fill:
            depth = size[0] / 2 + 0.2 if across else -(size[1] / 2 + inset)
            x, y, direction = line.at(u, side * (road.half_width + depth))
            turn = math.pi / 2 * side if across else (0.0 if side < 0 else math.pi)
            turn += math.pi if rng.random() < (0.4 if across else 0.1) else 0.0
            stage.add_object(name, x, y, direction + turn + rng.normal(0, 0.03), size)
        u += along / 2 + rng.exponential(0.7 if not across else 0.3) + 0.4


def _traffic(stage: Stage, line: _Line, density: float) -> None:
    rng, road = stage.rng, line.road
    kinds, shares = list(stage.object_mix.traffic), list(stage.object_mix.traffic.values())
    lanes = max(1, int(road.half_width / 3.0))
    for side in (1.0, -1.0):
        for lane in range(lanes):
            u = stage.ahead + rng.uniform(0, 25)
            while u < _REACH:
                if rng.random() < density:
                    name = str(rng.choice(kinds, p=shares))
                    s = side * (lane + 0.5) * min(3.3, road.half_width / lanes)
                    x, y, direction = line.at(u, s + rng.normal(0, 0.3))
                    turn = 0.0 if side < 0 else math.pi
                    stage.add_object(name, x, y, direction + turn + rng.normal(0, 0.05))
                u += rng.uniform(7, 30)


def _people(stage: Stage, line: _Line, count: int) -> None:
    rng, road = stage.rng, line.road
    for _ in range(count):
        side = 1.0 if rng.random() < 0.5 else -1.0
        u = rng.uniform(4, 50) if stage.ahead == 0 or rng.random() < 0.6 else rng.uniform(stage.ahead / 2, 4)
        kind = rng.random()
        if kind < stage.object_mix.walking:
            s = side * (road.half_width + rng.uniform(-1.0, max(road.pavement, 1.0)))
            x, y, direction = line.at(u, s)
            turn = direction + (0.0 if rng.random() < 0.5 else math.pi) + rng.normal(0, 0.5)
            for k in range(rng.integers(1, 4)):
                stage.add_object("Pedestrian", x + 0.1 * k, y + 0.75 * k, turn + rng.normal(0, 0.2))
        elif kind < stage.object_mix.riding:
            x, y, direction = line.at(u, side * (road.half_width + rng.uniform(-2.0, 1.5)))
            stage.add_object("Cyclist", x, y, direction + (0.0 if side < 0 else math.pi) + rng.normal(0, 0.15))
        else:
            x, y, direction = line.at(u, side * (road.half_width + rng.uniform(1.0, 3.0)))
            stage.add_object("Person_sitting", x, y, direction + rng.uniform(-math.pi, math.pi))


def random_street(stage: Stage, roads: tuple[Road, ...]) -> None:
    """Fill a stage with traffic, parked cars, people and scenery along its roads."""
    rng = stage.rng
    for number, road in enumerate(roads):
        line = _Line(road)
        lively = rng.uniform(0.0, 0.55) if number == 0 else rng.uniform(0.0, 0.3)
        _traffic(stage, line, lively)
        for side in (1.0, -1.0):
            kind = rng.random()
            if kind < 0.62:
                _parked(stage, line, side, rng.uniform(0.15, 1.0), across=rng.random() < 0.22)
        if rng.random() < 0.65:
            _people(stage, line, int(rng.integers(*stage.object_mix.people)))
    for _ in range(rng.integers(0, 6)):  # drives, yards, crossings: any heading
        x, y = rng.uniform(8, 60), rng.uniform(-25, 25)
        x = -x if stage.ahead < 0 and rng.random() < 0.5 else x
        name = str(rng.choice(stage.object_mix.strays))
        stage.add_object(name, x, y, rng.uniform(-math.pi, math.pi))
    for road in roads:
        add_scenery(stage, road)


def add_scenery(stage: Stage, road: Road) -> None:
    """Put scenery on both sides of a road: verge, fronts, and what stands behind."""
    rng = stage.rng
    line = _Line(road)
    for side in (1.0, -1.0):
        edge = road.half_width + road.pavement
        _verge(stage, line, side, edge)
        if rng.random() < 0.9:
            _fronts(stage, line, side, edge + rng.uniform(0.2, 9.0), rng.uniform(0.4, 1.0))
        if rng.random() < 0.35:
            _thicket(stage, line, side, edge + rng.uniform(0.5, 6.0))
        _clutter(stage, line, side, edge, int(rng.integers(2, 14)))
        _posts(stage, line, side, int(rng.integers(0, 16)))
        if rng.random() < 0.7:  # what stands behind
            _fronts(stage, line, side, edge + rng.uniform(14.0, 32.0), rng.uniform(0.5, 1.0), low=4.0)
    for _ in range(rng.integers(4, 30)):
        x, y = rng.uniform(stage.ahead or 5.0, _REACH), rng.uniform(-45, 45)
        if abs(y) > 6 and stage.sees(x, y):
            stage.add_scenery(scenery.tree(rng.uniform(3, 14), stage.palette, rng), x, y, rng.uniform(0, math.tau))


def _thicket(stage: Stage, line: _Line, side: float, setback: float) -> None:
    """A belt of bushes and trees along the road."""
    rng = stage.rng
    u, depth = stage.ahead + rng.uniform(4, 25), rng.uniform(1.0, 6.0)
    end = min(u + rng.uniform(10, 70), _REACH)
    while u < end:
        x, y, _ = line.at(u, side * (setback + rng.uniform(0, depth)))
        u += rng.uniform(0.5, 2.5)
        if not stage.sees(x, y):
            continue
        size = rng.uniform(0.8, 3.0)
        shape = scenery.bush(size, size * rng.uniform(0.6, 1.4), stage.palette, rng)
        if rng.random() < 0.25:
            shape = scenery.tree(rng.uniform(3, 9), stage.palette, rng)
        stage.add_scenery(shape, x, y, rng.uniform(0, math.tau), gap=-0.2)


def _verge(stage: Stage, line: _Line, side: float, edge: float) -> None:
    """Poles, trees, and perhaps a rail, at the kerb."""
    rng, road = stage.rng, line.road
    yaw_side = math.pi if side < 0 else 0.0
    u, step = stage.ahead + rng.uniform(2, 20), rng.uniform(7, 40)
    trees = rng.random() < 0.4
    while u < _REACH:
        x, y, direction = line.at(u, side * (road.half_width + rng.uniform(0.25, 0.9)))
        u += step * rng.uniform(0.5, 1.5)
        if not stage.sees(x, y):
            continue
        if trees and rng.random() < 0.7:
            shape = scenery.tree(rng.uniform(4, 11), stage.palette, rng)
        else:
            shape = scenery.pole(rng.uniform(1.0, 8.0), stage.palette, rng)
        stage.add_scenery(shape, x, y, direction + yaw_side, gap=0.1)
    if rng.random() < 0.1:
        for k in range(int((_REACH - stage.ahead) // 6)):
            x, y, direction = line.at(stage.ahead + 6.0 * k, side * (edge + 0.2))
            stage.add_scenery(scenery.rail(6.0, stage.palette, rng), x, y, direction, gap=0.0)


def _fronts(stage: Stage, line: _Line, side: float, setback: float, fill: float, low: float = 0.0) -> None:
    """Houses, walls, hedges and fences in a row, at least ``low`` metres high."""
    rng = stage.rng
    weights = rng.dirichlet((1.2, 0.6, 0.6, 0.4)) if low == 0 else (0.9, 0.0, 0.1, 0.0)
    u = stage.ahead + rng.uniform(-5, 5)
    while u < _REACH + 10:
        length = rng.uniform(4, 16)
        kind = rng.choice(4, p=weights)
        pieces = 1 if kind == 0 and not stage.guard else max(1, int(length // 3.0))
        height = max(low, rng.uniform(2.6, 12.0) if kind == 0 else rng.uniform(0.5, 2.4))
        depth = rng.uniform(4, 10)
        for k in range(pieces):
            part = length / pieces
            place = u + (k + 0.5) * part
            x, y, direction = line.at(place, side * setback)
            yaw = direction if side > 0 else direction + math.pi
            if rng.random() > fill or not stage.sees(x, y, max(part, depth)):
                continue
            if kind == 0:
                shape = scenery.house(part - 0.3, depth, height, stage.palette, rng)
            elif kind == 1:
                shape = scenery.wall(part - 0.25, height, stage.palette, rng)
            elif kind == 2:
                shape = scenery.hedge(part - 0.25, height, stage.palette, rng)
            else:
                shape = scenery.fence(part - 0.25, height, stage.palette, rng)
            stage.add_scenery(shape, x, y, yaw, gap=0.0)
        u += length + (rng.uniform(0, 8) if rng.random() < 0.4 else 0.0)
        setback += rng.normal(0, 0.4)


def _posts(stage: Stage, line: _Line, side: float, count: int) -> None:
    """Slender things on and behind the pavement, alone or in rows, which a network must learn to tell from people."""
    rng, road = stage.rng, line.road
    row, u = rng.random() < 0.3, rng.uniform(stage.ahead + 3, 40)
    s, step = road.half_width + rng.uniform(0.1, road.pavement + 3.0), rng.uniform(1.2, 4.0)
    shape = scenery.post(stage.palette, rng)
    for _ in range(count):
        if not row:
            u, s = rng.uniform(stage.ahead + 3, 55), road.half_width + rng.uniform(0.1, road.pavement + 8.0)
            shape = scenery.post(stage.palette, rng)
        x, y, direction = line.at(u, side * s)
        u += step
        if stage.sees(x, y):
            stage.add_scenery(shape, x, y, direction + rng.normal(0, 0.3), gap=0.3)


def _clutter(stage: Stage, line: _Line, side: float, edge: float, count: int) -> None:
    """Bushes, bins, heaps and low hedges: things of a car's size that are none."""
    rng = stage.rng
    for _ in range(count):
        u = rng.uniform(stage.ahead + 4, 60)
        x, y, direction = line.at(u, side * (edge + rng.uniform(-1.2, 12.0)))
        kind, turn = rng.random(), rng.uniform(0, math.tau)
        if not stage.sees(x, y):
            continue
        if kind < 0.35:
            shape = scenery.bush(rng.uniform(0.6, 2.2), rng.uniform(0.4, 2.4), stage.palette, rng)
        elif kind < 0.55:
            size = (rng.uniform(0.3, 3.5), rng.uniform(0.3, 1.8), rng.uniform(0.5, 2.0))
            shape, turn = scenery.bin_box(size, stage.palette, rng), direction + rng.normal(0, 0.2)
        elif kind < 0.7:
            shape, turn = scenery.hedge(rng.uniform(1, 5), rng.uniform(0.4, 1.8), stage.palette, rng), direction
        elif kind < 0.8:
            shape = scenery.rubble(rng.uniform(0.5, 2.0), stage.palette, rng)
        else:
            shape = scenery.pole(rng.uniform(0.6, 6.0), stage.palette, rng)
        stage.add_scenery(shape, x, y, turn)
