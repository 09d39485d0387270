"""The check of a data set accuses the right thing, and nothing in a sound one; anchors come from the labels."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from beambox.cli.data import app, spread
from beambox.data.anchor_sizes import proposals_text, propose_anchors
from beambox.data.checking import check_frames
from beambox.data.custom import CustomSource
from beambox.data.format_report import warnings
from beambox.structures import Labels
from oracles.own_data import write_pandaset


def found(path: Path, ground: float | None = -1.73) -> list[str]:
    source = CustomSource(path, whole=True)
    return warnings(check_frames(source, limits=source.config.range), ground)


def test_check_finds_nothing_in_sound_data(tmp_path: Path) -> None:
    assert found(write_pandaset(tmp_path)) == []


def turned(boxes: np.ndarray) -> np.ndarray:
    boxes[:, 6] += np.pi / 2
    return boxes


def mirrored(boxes: np.ndarray) -> np.ndarray:
    boxes[:, 6] *= -1
    return boxes


def swapped(boxes: np.ndarray) -> np.ndarray:
    boxes[:, [3, 4]] = boxes[:, [4, 3]]
    return boxes


def lifted(boxes: np.ndarray) -> np.ndarray:
    boxes[:, 2] -= boxes[:, 5] / 2
    return boxes


def far(boxes: np.ndarray) -> np.ndarray:
    boxes[0, :3] = (500, 0, 0)
    return boxes


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (turned, ["boxes hold more points when turned by 90 degrees"]),
        (mirrored, ["does yaw grow clockwise?"]),
        (swapped, ["are l and w swapped?", "boxes hold more points when turned by 90 degrees"]),
        (lifted, ["0.75 m below the ground; is z the lower face instead of the centre?"]),
        (far, ["3 of 24 boxes hold no point", "3 of 24 boxes lie outside the range"]),
    ],
)
def test_check_accuses(tmp_path: Path, change: Callable, wanted: list[str]) -> None:
    lines = found(write_pandaset(tmp_path, 3, "sensor_height: 2\nrange: 50\n", change))
    assert len(lines) == len(wanted)
    for line, piece in zip(lines, wanted):
        assert line.startswith("Car: ") and piece in line


def test_check_measures_the_ground(tmp_path: Path) -> None:
    lines = found(write_pandaset(tmp_path, 2, "sensor_height: 0.5\n"))
    assert lines == ["the ground lies 1.50 m below where sensor_height puts it; raise sensor_height by 1.50"]


def test_check_measures_a_ground_that_leans(tmp_path: Path) -> None:
    path = write_pandaset(tmp_path, 2, "sensor_height: 2\n", lean)
    for sweep in sorted((tmp_path / "velodyne").iterdir()):
        points = np.fromfile(sweep, "<f4").reshape(-1, 4)
        points[:, 2] += 0.01 * points[:, 0] - 0.04 * points[:, 1]
        points.tofile(sweep)
    (lines,) = found(path)
    actual = re.fullmatch(
        r"the ground rises by (\d\.\d)% to the right, 1\.\d m at 40 m; "
        r"add \{forward: (0\.0\d+), left: (-0\.0\d+)\} to ground_slope",
        lines,
    )
    assert actual is not None
    assert float(actual[2]) == pytest.approx(0.01, abs=0.003)
    assert float(actual[3]) == pytest.approx(-0.04, abs=0.003)
    path.write_text(path.read_text() + "ground_slope: {forward: 0.01, left: -0.04}\n")
    assert found(path) == []
    frame = CustomSource(path)[0]
    level = write_pandaset(tmp_path / "level", 1, "sensor_height: 2\n")
    wanted = CustomSource(level)[0]
    assert torch.allclose(frame.points, wanted.points, atol=1e-4)
    assert torch.allclose(frame.labels.boxes, wanted.labels.boxes, atol=1e-3)


def lean(boxes: np.ndarray) -> np.ndarray:
    boxes[:, 2] += 0.01 * boxes[:, 0] - 0.04 * boxes[:, 1]
    return boxes


def test_check_lists_frames(tmp_path: Path) -> None:
    path = write_pandaset(tmp_path, 5, "sensor_height: 2\nintensity_scale: 1\n")
    (tmp_path / "velodyne" / "00.bin").write_bytes(b"")
    (tmp_path / "boxes" / "01.txt").unlink()
    (tmp_path / "boxes" / "02.txt").write_text("", encoding="utf-8")
    (tmp_path / "velodyne" / "03.bin").write_bytes(b"12345")
    lines = found(path)
    assert lines[0].startswith("cannot be read: ") and "03.bin must hold whole points" in lines[0]
    assert lines[1:4] == [
        "1 of 5 frames have no point: 00",
        "1 of 5 frames have no label file: 01",
        "1 of 5 frames are labelled and have no box: 02",
    ]


def test_anchors_are_mean_sizes_on_the_ground(tmp_path: Path) -> None:
    source = CustomSource(write_pandaset(tmp_path))
    proposals = propose_anchors(labels for labels in (source.labels(i) for i in range(3)) if labels is not None)
    assert [(one.name, one.boxes, one.size) for one in proposals] == [("Car", 24, (4.4, 1.8, 1.5))]
    assert proposals[0].bottom_z == pytest.approx(-1.73, abs=0.01)
    assert (proposals[0].matched_threshold, proposals[0].unmatched_threshold, proposals[0].covered) == (0.6, 0.45, 1.0)


def test_anchors_that_fit_badly_or_rest_on_little_say_so() -> None:
    boxes = torch.zeros(44, 7)
    boxes[:40, 3:6] = torch.tensor([[4.0, 2, 1.5], [12, 2.5, 3]]).repeat(20, 1)
    boxes[40:, 3:6] = torch.tensor([0.8, 0.6, 1.7])
    text = proposals_text(propose_anchors([Labels(boxes, ("Vehicle",) * 40 + ("Pedestrian",) * 4)]))
    assert "{name: Vehicle, size: [8.00, 2.25, 2.25], bottom_z: -1.12, matched_threshold: 0.60, " in text
    assert "# Vehicle: sizes vary much" in text and "# Pedestrian: few boxes" in text


def test_data_commands(tmp_path: Path) -> None:
    path = write_pandaset(tmp_path)
    done = CliRunner().invoke(app, ["check", str(path), "--frames", "2", "--json", str(tmp_path / "report.json")])
    assert done.exit_code == 0, done.output
    assert "2 frames, 7200 points per frame" in done.output and "nothing looks wrong" in done.output
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["classes"][0]["boxes"] == 16 and report["warnings"] == []
    done = CliRunner().invoke(app, ["anchors", str(path)])
    assert done.exit_code == 0 and "{name: Car, size: [4.40, 1.80, 1.50], bottom_z: -1.73" in done.output
    (tmp_path / "velodyne" / "01.bin").write_bytes(b"1")
    done = CliRunner().invoke(app, ["check", str(path)])
    assert done.exit_code == 2 and "1 of 3 frames cannot be read" in done.stderr
    assert "! cannot be read:" in done.stdout
    done = CliRunner().invoke(app, ["check", str(tmp_path / "none")])
    assert done.exit_code == 2 and done.stderr.count("\n") == 1


def test_frames_are_spread_evenly() -> None:
    assert spread(10, None) == list(range(10)) == spread(10, 20)
    assert spread(10, 4) == [0, 3, 6, 9] and spread(10, 1) == [0]
