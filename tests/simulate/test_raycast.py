from __future__ import annotations

import math

import numpy as np
import pytest

from beambox.simulate.ground import Ground, Road, ground_height
from beambox.simulate.materials import AIR, BARK, GLASS, Palette
from beambox.simulate.raycast import Hits, Placed, cast, pack
from beambox.simulate.shapes import Shape
from beambox.simulate.vehicles import car
from oracles.marching import depth_inside, walk

FLAT = Ground(-1.7, (0.0, 0.0), (0.0, 0.0), np.zeros((0, 4)), (), roughness=(0.0, 0.0, 0.0))
DEEP = Ground(-500.0, (0.0, 0.0), (0.0, 0.0), np.zeros((0, 4)), (), roughness=(0.0, 0.0, 0.0))


def shoot(placed: list[Placed], azimuths, elevations, ground: Ground = DEEP, seed: int = 0, z: float = 0.0) -> Hits:
    azimuths, elevations = np.atleast_1d(np.asarray(azimuths, float)), np.atleast_1d(np.asarray(elevations, float))
    beams = np.stack((elevations, np.full(len(elevations), z)), axis=1)
    table = Palette(np.random.default_rng(0)).table()
    table = np.concatenate((table, np.tile(table[BARK], (40, 1))))  # room for materials that builders add
    return cast(pack(placed, (z, z)), ground.pack(), table, seed, azimuths, np.zeros(len(beams)), beams, 120.0, 0.003)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    c = math.cos(elevation)
    return np.array([c * math.cos(azimuth), c * math.sin(azimuth), math.sin(elevation)])


def test_flat_ground_lies_at_height_over_sine() -> None:
    elevations = np.radians([-2.0, -5.0, -24.0])
    hits = shoot([], [0.0, 2.0], elevations, FLAT)
    want = np.repeat(1.7 / np.sin(-elevations), 2)
    np.testing.assert_allclose(hits.distance, want, atol=0.1)  # 2 mm of height, seen at 2 degrees
    assert (hits.owner == -1).all()
    assert np.isinf(shoot([], [0.0], [0.05], FLAT).distance).all()


def test_uneven_ground_is_hit_on_its_surface() -> None:
    rng = np.random.default_rng(1)
    waves = np.stack((rng.uniform(0, 0.05, 4), *rng.uniform(-0.4, 0.4, (2, 4)), rng.uniform(0, 6, 4)), axis=1)
    road = Road(0.1, 1.0, 4.0, 0.12, 2.0, 0.001)
    ground = Ground(-1.7, (0.01, -0.02), (0.0002, -0.0001), waves, (road,), 0.04, 0.1, 0.5, (0.0, 0.0, 0.0))
    azimuths, elevations = np.linspace(-3, 3, 60), np.radians(np.linspace(-24, -1.5, 20))
    hits = shoot([], azimuths, elevations, ground)
    packed, kerbs = ground.pack(), 0
    for k in np.flatnonzero(np.isfinite(hits.distance)):
        x, y, z = direction(azimuths[k % 60], elevations[k // 60]) * hits.distance[k]
        away = abs(z - ground_height(packed, x, y))
        kerbs += away > 0.01
        assert away < 0.13  # never more than the kerb's face
    assert kerbs < 0.05 * len(hits.distance)


@pytest.mark.parametrize("seed", range(4))
def test_turned_and_tilted_box_is_met_where_walking_meets_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = Shape()
    shape.box((-2.0, -0.8, 0.0), (2.0, 0.8, 1.5), BARK)
    shape.ellipsoid((0.5, 0.3, 1.8), (0.6, 0.3, 0.4), BARK)
    shape.prism(-1.0, 0.0, 0.3, 1.5, 2.5, BARK)
    place = tuple(rng.uniform((5, -3, -2), (9, 3, -1)))
    placed = Placed(shape, place, *rng.uniform(-3, 3, 1), *rng.uniform(-0.2, 0.2, 2))
    middle = math.atan2(place[1], place[0])
    azimuths, elevations = middle + np.linspace(-0.25, 0.25, 5), np.linspace(-0.3, 0.15, 5)
    hits = shoot([placed], azimuths, elevations)
    met = 0
    for k, distance in enumerate(hits.distance):
        ray = direction(azimuths[k % 5], elevations[k // 5])
        want = walk(placed, ray, 12.0)
        if math.isinf(want) != math.isinf(distance):  # a graze: the step may jump over a corner
            assert depth_inside(placed, ray * min(want, distance))[0] < 0.02
            continue
        met += math.isfinite(want)
        assert math.isinf(want) or distance == pytest.approx(want, abs=0.003)
    assert met >= 5


def test_sphere_is_met_at_the_closed_form_distance() -> None:
    shape = Shape()
    shape.ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), BARK)
    hits = shoot([Placed(shape, (0.0, 10.0, 0.0), 0.3)], math.pi / 2 + np.array([0.0, 0.05, 0.11]), [0.0])
    want = 10 * math.cos(0.05) - math.sqrt(1 - (10 * math.sin(0.05)) ** 2)
    np.testing.assert_allclose(hits.distance, [9.0, want, np.inf], rtol=1e-9)
    assert hits.cosine[0] == pytest.approx(1.0)


def test_beams_pass_air_and_most_panes() -> None:
    shape = Shape()
    shape.box((-0.5, -3.0, -3.0), (0.5, 3.0, 3.0), AIR)
    azimuths = np.linspace(-0.2, 0.2, 400)
    assert np.isinf(shoot([Placed(shape, (8.0, 0.0, 0.0), 0.0)], azimuths, [0.0]).distance).all()
    pane = Shape()
    pane.box((-0.5, -3.0, -3.0), (0.5, 3.0, 3.0), GLASS)
    got = np.isfinite(shoot([Placed(pane, (8.0, 0.0, 0.0), 0.0)], azimuths, [0.0]).distance).mean()
    assert 0.05 < got < 0.5


def test_leaves_are_entered_before_they_return() -> None:
    shape = Shape()
    shape.box((0.0, -3.0, -3.0), (2.0, 3.0, 3.0), BARK, density=3.0)
    hits = shoot([Placed(shape, (8.0, 0.0, 0.0), 0.0)], np.linspace(-0.2, 0.2, 500), [0.0])
    met = hits.distance[np.isfinite(hits.distance)]
    assert len(met) > 450  # all but exp(-6) of them, and the far corners
    assert met.min() >= 8.0
    assert (met - 8.0).mean() == pytest.approx(1 / 3, abs=0.12)


def test_losses_to_what_stands_before_are_counted() -> None:
    target, half, whole = Shape(), Shape(), Shape()
    target.box((-0.5, -1.0, -1.0), (0.5, 1.0, 1.0), BARK)
    half.box((-0.1, 0.0, -2.0), (0.1, 3.0, 2.0), BARK)
    whole.box((-0.1, -3.0, -2.0), (0.1, 3.0, 2.0), BARK)
    azimuths, elevations = np.linspace(-0.1, 0.1, 101), np.linspace(-0.05, 0.05, 5)

    def share(*before: Shape) -> float:
        placed = [Placed(target, (12.0, 0.0, 0.0), 0.0, name="Car")]
        placed += [Placed(shape, (6.0, 0.0, 0.0), 0.0) for shape in before]
        hits = shoot(placed, azimuths, elevations)
        assert hits.unoccluded_hits[0] > 300
        return hits.hits[0] / hits.unoccluded_hits[0]

    assert share() == 1.0
    assert share(half) == pytest.approx(0.5, abs=0.02)
    assert share(whole) == 0.0


def test_object_behind_the_seam_and_around_the_sensor_is_met() -> None:
    box = Shape()
    box.box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), BARK)
    hits = shoot([Placed(box, (-10.0, 0.0, 0.0), 0.0)], [math.pi - 0.01, -math.pi + 0.01, 0.0], [0.0])
    np.testing.assert_allclose(hits.distance, [9 / math.cos(0.01)] * 2 + [np.inf])
    wall = Shape()
    wall.box((-30.0, -0.1, -2.0), (30.0, 0.1, 2.0), BARK)
    hits = shoot([Placed(wall, (0.0, 2.0, 0.0), 0.0)], np.radians([10.0, 90.0, 170.0, -90.0]), [0.0])
    np.testing.assert_allclose(hits.distance, [1.9 / math.sin(math.radians(10))] * 1 + [1.9]
                               + [1.9 / math.sin(math.radians(10))] + [np.inf])  # fmt: skip


def test_chance_depends_on_seed_and_beam_alone() -> None:
    rng = np.random.default_rng(0)
    placed = [Placed(car((4.0, 1.6, 1.5), Palette(rng), rng), (9.0, 1.0, -1.7), 0.7, name="Car")]
    azimuths, elevations = np.linspace(-0.3, 0.5, 120), np.radians(np.linspace(-10, 0, 12))
    first, again = (shoot(placed, azimuths, elevations, FLAT, seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.distance, again.distance)
    part = shoot(placed, azimuths, elevations[:1], FLAT, seed=4)
    np.testing.assert_array_equal(part.distance, first.distance[:120])
    assert (shoot(placed, azimuths, elevations, FLAT, seed=5).distance != first.distance).any()
