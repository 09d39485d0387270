"""The doctor finds what was done to a healthy street, names the option that undoes it, and leaves health alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.pointpillars import KITTI_PILLARS
from beambox.geometry.axes import Axes
from beambox.infer import doctor
from beambox.infer.doctor import Diagnosis
from beambox.infer.sensor_profile import SensorProfile
from oracles.paths import data_dir
from oracles.tiny_detector import street

TRAINED = SensorProfile(KITTI_PILLARS, points=6000)


def diagnose(points: np.ndarray, folder: Path) -> Diagnosis:
    points.astype(np.float32).tofile(folder / "scan.bin")
    return doctor.diagnose(folder / "scan.bin", TRAINED)


def turned(points: np.ndarray, axes: str) -> np.ndarray:
    """Return points as a sensor with those axes gives them."""
    out = points.copy()
    out[:, :3] = points[:, :3] @ Axes.parse(axes).matrix.numpy()
    return out


@pytest.mark.parametrize("ahead_only", [False, True])
def test_a_healthy_street_needs_nothing(tmp_path: Path, ahead_only: bool) -> None:
    diagnosis = diagnose(street(ahead_only=ahead_only), tmp_path)
    assert diagnosis.options == ()
    assert not [finding for finding in diagnosis.findings if finding.level == "bad"]


@pytest.mark.parametrize("height", [0.0, 0.6, 1.2, 2.6])
def test_another_height_is_measured(tmp_path: Path, height: float) -> None:
    diagnosis = diagnose(street(height=height), tmp_path)
    assert diagnosis.options[0] == "--sensor-height"
    assert float(diagnosis.options[1]) == pytest.approx(height, abs=0.05)
    assert diagnosis.alignment.z_offset == pytest.approx(height - 1.73, abs=0.05)


def test_a_ground_that_leans_is_a_note_with_the_option(tmp_path: Path) -> None:
    points = street()
    points[:, 2] += 0.01 * points[:, 0] - 0.05 * points[:, 1]
    diagnosis = diagnose(points, tmp_path)
    (slope,) = [finding for finding in diagnosis.findings if finding.about == "slope"]
    assert slope.level == "note" and slope.option == ()
    forward, left = re.findall(r"--ground-slope (\S+),(\S+) makes it level", slope.text)[0]
    assert float(forward) == pytest.approx(0.01, abs=0.005)
    assert float(left) == pytest.approx(-0.05, abs=0.005)


@pytest.mark.parametrize("axes", ["x: right, y: forward, z: up", "x: backward, y: right, z: up",
                                  "x: left, y: backward, z: up"])  # fmt: skip
def test_a_sector_that_does_not_lie_ahead_gives_the_axes(tmp_path: Path, axes: str) -> None:
    diagnosis = diagnose(turned(street(ahead_only=True), axes), tmp_path)
    assert diagnosis.options == ("--axes", axes)


@pytest.mark.parametrize("axes", ["x: right, y: down, z: forward", "x: forward, y: right, z: down",
                                  "x: left, y: up, z: forward"])  # fmt: skip
def test_another_vertical_gives_the_axes(tmp_path: Path, axes: str) -> None:
    assert diagnose(turned(street(), axes), tmp_path).options == ("--axes", axes)


def test_axes_and_height_are_found_together(tmp_path: Path) -> None:
    options = diagnose(turned(street(height=0.8), "x: right, y: down, z: forward"), tmp_path).options
    assert options[:3] == ("--axes", "x: right, y: down, z: forward", "--sensor-height")
    assert float(options[3]) == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(("factor", "expected"), [(0.1, 10), (1 / 255, 255)])
def test_dark_intensity_gets_a_factor(tmp_path: Path, factor: float, expected: float) -> None:
    diagnosis = diagnose(street() * np.array([1, 1, 1, factor]), tmp_path)
    assert diagnosis.options[0] == "--intensity-scale"
    assert diagnosis.intensity_scale == pytest.approx(expected, rel=0.3)


def test_intensity_in_a_usual_unit_that_reading_takes_for_another(tmp_path: Path) -> None:
    """Twelve bits, nearly all dark: reading divides by 65535, which leaves next to nothing."""
    diagnosis = diagnose(street() * np.array([1, 1, 1, 4095]), tmp_path)
    assert diagnosis.options == ("--intensity-scale", "0.00024")


def test_no_intensity_is_a_note_without_a_remedy(tmp_path: Path) -> None:
    diagnosis = diagnose(street() * np.array([1, 1, 1, 0]), tmp_path)
    assert diagnosis.options == ()
    assert any(f.about == "intensity" and f.level == "note" and "all 0" in f.text for f in diagnosis.findings)


@pytest.mark.parametrize(("factor", "words"), [(1000, "millimetres"), (0.01, "multiply first")])
def test_other_units_are_told(tmp_path: Path, factor: float, words: str) -> None:
    finding = diagnose(street() * np.array([factor, factor, factor, 1]), tmp_path).findings[0]
    assert finding.level == "bad" and words in finding.text


def test_an_empty_sweep_is_told_and_a_broken_one_refused(tmp_path: Path) -> None:
    assert [f.text for f in diagnose(np.zeros((0, 4)), tmp_path).findings] == ["the sweep has no points"]
    (tmp_path / "cut.bin").write_bytes(bytes(range(9)))
    with pytest.raises(BeamboxError, match="cut short"):
        doctor.diagnose(tmp_path / "cut.bin", TRAINED)


def test_dropped_points_and_points_behind_are_told(tmp_path: Path) -> None:
    spoilt = np.concatenate((street(), np.full((5, 4), np.nan)))
    texts = [finding.text for finding in diagnose(spoilt, tmp_path).findings]
    assert any("dropped 5 of 16905 points" in text for text in texts)
    assert any("--range 50 looks all around" in text for text in texts)


def test_a_few_points_do_not_break_it(tmp_path: Path) -> None:
    for count in (1, 2, 30):
        assert diagnose(street()[:count], tmp_path).findings


def test_the_card_says_what_training_was_like() -> None:
    sensor_profile = SensorProfile.of({"sensor height": 2.1, "intensity_mean": 0.4, "licence": "CC0"}, KITTI_PILLARS)
    assert (sensor_profile.sensor_height, sensor_profile.intensity_mean, sensor_profile.points) == (2.1, 0.4, 18_000)


def test_real_sweeps_are_healthy_and_their_copies_with_other_axes_are_not(tmp_path: Path) -> None:
    for path in sorted(data_dir("kitti", "training", "velodyne").glob("*.bin"))[:12:3]:
        assert doctor.diagnose(path, SensorProfile(KITTI_PILLARS)).options == (), path.name
        points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
        camera = turned(points, "x: right, y: down, z: forward")
        assert diagnose(camera, tmp_path).options == ("--axes", "x: right, y: down, z: forward"), path.name


def test_a_real_sweep_with_its_origin_on_the_ground_gets_a_height() -> None:
    options = doctor.diagnose(data_dir("pandaset_002", "velodyne", "00.bin"), SensorProfile(KITTI_PILLARS)).options
    assert options[0] == "--sensor-height" and abs(float(options[1])) < 0.5
    assert torch.tensor(float(options[3])) > 1, "its intensity is much darker than KITTI's"
