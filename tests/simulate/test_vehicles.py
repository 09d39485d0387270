from __future__ import annotations

import math

import numpy as np
import pytest

from beambox.simulate import people, vehicles
from beambox.simulate.ground import Ground
from beambox.simulate.materials import AIR, GLASS, Palette
from beambox.simulate.object_mix import SIZES, draw_size
from beambox.simulate.raycast import Placed, cast, pack
from oracles.marching import depth_inside, to_local

FAR = Ground(-300.0, (0.0, 0.0), (0.0, 0.0), np.zeros((0, 4)), (), roughness=(0.0, 0.0, 0.0))
BUILDERS = {
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


def scan(name: str, size, seed: int) -> tuple[Placed, np.ndarray]:
    """Hits of a dense sensor, in the object's frame, from a side that the seed chooses."""
    rng = np.random.default_rng(seed)
    palette = Palette(rng)
    shape = BUILDERS[name](size, palette, rng)
    placed = Placed(shape, (4.0 + size[0], 0.5, -1.7), rng.uniform(-3, 3), name=name)
    azimuths, elevations = np.linspace(-0.9, 0.9, 300), np.radians(np.linspace(-30, 15, 45))
    beams = np.stack((elevations, np.zeros(45)), axis=1)
    hits = cast(pack([placed], (0, 0)), FAR.pack(), palette.table(), 1, azimuths, np.zeros(45), beams, 100.0, 0.006)
    k = np.flatnonzero(hits.owner == 0)
    e, a = elevations[k // 300], azimuths[k % 300]
    xyz = np.stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)), axis=1) * hits.distance[k, None]
    return placed, xyz


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", BUILDERS)
def test_shape_fills_its_box_and_stays_inside(name: str, seed: int) -> None:
    size = draw_size(name, np.random.default_rng(seed + 50))
    placed, xyz = scan(name, size, seed)
    local = to_local(placed, xyz)
    assert len(local) > 80
    half = np.array([size[0] / 2, size[1] / 2, size[2] / 2]) + 0.05
    inside = (np.abs(local - (0, 0, size[2] / 2)) <= half).all(axis=1)
    assert inside.mean() >= 0.95
    low, high = np.array(placed.shape.low), np.array(placed.shape.high)
    assert (high - low)[0] == pytest.approx(size[0], abs=0.32)
    assert (high - low)[2] == pytest.approx(size[2], abs=0.20)
    assert local[:, 2].min() >= -0.01


@pytest.mark.parametrize("name", ["Car", "Van", "Truck", "Pedestrian", "Cyclist"])
def test_no_beam_ends_inside_a_solid_part(name: str) -> None:
    placed, xyz = scan(name, SIZES[name][0], 7)
    assert depth_inside(placed, xyz, frozenset({GLASS, AIR})).max() < 1e-6


def test_windows_of_cars_let_beams_through_to_the_seats() -> None:
    inner, upper = 0, 0
    for seed in range(6):
        size = SIZES["Car"][0]
        placed, xyz = scan("Car", size, seed)
        local = to_local(placed, xyz)
        high = (local[:, 2] > 0.66 * size[2]) & (local[:, 2] < 0.9 * size[2])
        inner += int((high & (np.abs(local[:, 0]) < 0.3 * size[0]) & (np.abs(local[:, 1]) < 0.3 * size[1])).sum())
        upper += int(high.sum())
    assert 0.05 < inner / upper < 0.6


def test_a_car_is_no_cuboid() -> None:
    size = (4.0, 1.65, 1.5)
    rng = np.random.default_rng(3)
    placed = Placed(vehicles.car(size, Palette(rng), rng), (0.0, 0.0, 0.0), 0.0)

    def solid(x: float, y: float, z: float) -> bool:
        return bool(depth_inside(placed, np.array([[x, y, z]]))[0] > 0)

    assert solid(1.6, 0.0, 0.5) and not solid(1.6, 0.0, 1.2)  # bonnet, and air above it
    assert not solid(1.97, 0.80, 0.6)  # rounded corner
    assert not solid(0.0, 0.0, 0.1)  # clear of the ground
    assert solid(0.0, 0.76, 0.6) and not solid(-0.4, 0.76, 1.4)  # door, and tumblehome above it


def test_drawn_sizes_follow_the_class() -> None:
    rng = np.random.default_rng(0)
    sizes = np.array([draw_size("Car", rng) for _ in range(3000)])
    np.testing.assert_allclose(sizes.mean(axis=0), SIZES["Car"][0], atol=0.03)
    assert np.corrcoef(sizes[:, 0], sizes[:, 1])[0, 1] > 0.3
    assert math.isclose(sizes[:, 0].std(), 0.42, abs_tol=0.06)
