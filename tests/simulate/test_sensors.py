from __future__ import annotations

import numpy as np
import pytest

from beambox.checks import BeamboxError, MissingFileError
from beambox.simulate import SENSORS, Sensor, load_sensor, simulate_frame


def test_hdl64_is_near_the_manufacturers_table() -> None:
    sensor = SENSORS["hdl64"]
    nominal = np.concatenate((2.0 - np.arange(32) / 3, -8.83 - np.arange(32) / 2))
    actual = np.array(sensor.elevations)
    assert len(actual) == 64
    assert (np.diff(actual) < 0).all()
    assert np.abs(actual - nominal).max() < 0.75
    assert sensor.columns == 2003
    assert sensor.height == 1.73


@pytest.mark.parametrize(("name", "beams"), [("hdl64", 64), ("hdl32", 32), ("pandar40", 40), ("pandar64", 64)])
def test_presets_have_their_beams(name: str, beams: int) -> None:
    sensor = load_sensor(name)
    assert len(sensor.elevations) == beams
    assert len(set(sensor.elevations)) == beams
    assert sensor.name == name


def test_presets_follow_their_makers_tables() -> None:
    """First and last angles and steps of HDL-32E and Pandar40; of Pandar64 some channels of Hesai's driver."""
    hdl32, pandar40, pandar64 = (np.array(SENSORS[name].elevations) for name in ("hdl32", "pandar40", "pandar64"))
    assert hdl32[[0, 8, 31]].tolist() == [10.667, 0.0, -30.667]
    assert np.allclose(np.diff(hdl32), -4 / 3, atol=1e-3)
    assert pandar40[[0, 1, 2, 3, 4, 5, 11, 29]].tolist() == [15, 11, 8, 5, 3, 2, 0, -6]
    assert np.allclose(np.diff(pandar40[5:30]), -1 / 3, atol=1e-3)
    assert pandar40[30:].tolist() == [-7, -8, -9, -10, -11, -12, -13, -14, -19, -25]
    assert pandar64[[0, 5, 17, 53, 63]].tolist() == [14.882, 2.028, 0.0, -6.061, -24.897]
    assert np.abs(np.diff(pandar64[5:54]) + 1 / 6).max() < 0.01
    for table in (hdl32, pandar40, pandar64):
        assert (np.diff(table) < 0).all()


def test_own_sensor_from_yaml_is_cast(tmp_path) -> None:
    path = tmp_path / "tiny.yaml"
    path.write_text("elevations: [-4, -8, -12]\nazimuth_step: 0.5\nheight: 2.4\nmax_range: 60\nrange_noise: 0\n")
    sensor = load_sensor(path)
    assert sensor == Sensor("tiny", (-4.0, -8.0, -12.0), 0.5, 2.4, range_noise=0.0, max_range=60.0)
    points = simulate_frame(0, 0, sensor=sensor, view="full").points.numpy().astype(float)
    assert 300 < len(points) <= 3 * 720
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    assert (np.abs(elevation[:, None] - [-4, -8, -12]).min(axis=1) < 1e-3).all()
    assert np.linalg.norm(points[:, :3], axis=1).max() < 60
    near = points[(np.abs(elevation + 12) < 0.1) & (points[:, 3] > 0)]
    assert np.median(near[:, 2]) == pytest.approx(-2.4, abs=0.3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("elevation: [1]\n", r"unknown key 'elevation' \(did you mean \"elevations\""),
        ("elevations: [1]\nheight: 2\n", "lacks azimuth_step"),
        ("elevations: [1, x]\nheight: 2\nazimuth_step: 1\n", "elevations must be numbers"),
        ("elevations: [1]\nheight: 2\nazimuth_step: 0\n", "`azimuth_step` must be greater than 0, got 0.0"),
        ("elevations: []\nheight: 2\nazimuth_step: 1\n", "`elevations` must hold one angle per beam"),
        ("elevations: [95]\nheight: 2\nazimuth_step: 1\n", "between -90 and 90"),
        ("elevations: [1]\noffsets: [1, 2]\nheight: 2\nazimuth_step: 1\n", "must be empty or one per beam"),
        ("- 1\n", "must hold keys and values, got list"),
        ("a: [1\n", "is not valid YAML"),
    ],
)
def test_bad_sensor_files_are_refused(tmp_path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(BeamboxError, match=message):
        load_sensor(path)


def test_missing_sensor_file_is_refused(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="is not there; give a preset"):
        load_sensor(tmp_path / "none.yaml")
