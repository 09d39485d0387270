"""Sizes that fit no memory are refused before they are asked for; units and unseen points are said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.cli.detect import unseen
from beambox.detectors.catalog import build
from beambox.detectors.pointpillars import KITTI_PILLARS
from beambox.geometry import VoxelGrid
from beambox.infer.doctor import diagnose
from beambox.infer.predictor import Detector, region
from beambox.infer.sensor_profile import SensorProfile
from beambox.simulate.sensors import load_sensor
from beambox.structures import Frame
from oracles.own_data import scene


@pytest.mark.parametrize("wanted", [1e5, 1e300, float("inf"), float("nan"), [0, 0, 1e5, 1e5]])
def test_ranges_that_fit_no_memory_are_refused(wanted: float | list[float]) -> None:
    with pytest.raises(BeamboxError, match=r"fits no memory|one number, or x_min|finite"):
        region(KITTI_PILLARS, wanted)
    assert region(KITTI_PILLARS, 100).size[0] > 1000


@pytest.mark.parametrize("low", [-1e9, float("-inf"), float("nan")])
def test_grids_of_a_thousand_million_cells_are_refused(low: float) -> None:
    with pytest.raises(BeamboxError, match=r"fits no memory|finite"):
        VoxelGrid((low, 0.0, -3.0), (70.0, 40.0, 1.0), (0.05, 0.05, 0.1))


@pytest.mark.parametrize(
    "line", ["azimuth_step: 1.0e-9", "azimuth_step: .inf", "azimuth_step: .nan", "max_range: .inf", "height: 1.0e300",
             "range_noise: .inf", "min_range: 90", "sensitivity: .nan", "elevations: [.inf]"],
)  # fmt: skip
def test_sensors_that_cannot_be_are_refused(tmp_path: Path, line: str) -> None:
    keys = {"elevations": "[0, 1]", "azimuth_step": "0.2", "height": "1.7", "max_range": "80"}
    key, _, value = line.partition(": ")
    text = "".join(f"{name}: {one}\n" for name, one in {**keys, key: value}.items())
    (tmp_path / "s.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"s\.yaml"):
        load_sensor(tmp_path / "s.yaml")


def test_doctor_stops_at_units(tmp_path: Path) -> None:
    """A cloud in millimetres got the advice --range 15070, which asked for 726 GB."""
    points = scene(0)[0] * np.array([1000, 1000, 1000, 1])
    points.astype("<f4").tofile(tmp_path / "mm.bin")
    diagnosis = diagnose(tmp_path / "mm.bin", SensorProfile(KITTI_PILLARS))
    assert diagnosis.options == () and "divide them by 1000" in diagnosis.findings[-1].text


def test_detect_says_what_it_does_not_look_at() -> None:
    options = {
        "grid": {"minimum": [0.0, -6.4, -3.0], "maximum": [12.8, 6.4, 1.0], "cell": [0.4, 0.4, 4.0]},
        "pillar_channels": 4, "depths": [1, 1], "strides": [2, 2], "widths": [8, 8], "up_strides": [1, 2],
        "up_widths": [8, 8],
    }  # fmt: skip
    detector = Detector(build("pointpillars", options), device="cpu", precision="float32")
    turn = torch.linspace(0, 6.28, 1000)
    points = torch.stack((10 * turn.cos(), 6 * turn.sin(), torch.zeros(1000), torch.zeros(1000)), dim=1)
    output = unseen(detector, Frame(points))
    assert output.startswith("50% of the points lie where the network does not look") and "--range 50" in output
    assert unseen(detector, Frame(points[points[:, 0] > 0])) == ""
