"""`beambox detect` as a user meets it: results that are right, and errors of one line that say what to do."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest

import beambox as package
from beambox.infer.predictor import Detector
from oracles.command_line import beambox
from oracles.tiny_detector import kitti_folder, street, tiny_weights

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    street().tofile(tmp_path / "scan.bin")
    return tmp_path / "scan.bin"


def detections_in(path: Path) -> list[dict[str, object]]:
    return json.loads(path.read_text(encoding="utf-8"))["detections"]


def test_one_sweep_becomes_one_file(capsys: Capture, weights: Path, scan: Path, tmp_path: Path) -> None:
    ran = beambox(capsys, "detect", scan, "--model", weights, "--out", tmp_path / "out")
    assert ran.status == 0, ran.err
    assert ran.out.startswith("scan: ") and ran.out.endswith("scan.json\n")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["scan.json"]
    found = package.load(weights)(scan)
    assert len(detections_in(tmp_path / "out" / "scan.json")) == len(found) > 3
    assert f"beambox {package.__version__} detect" in ran.err, "a long command says its version"


def test_the_command_gives_what_the_library_gives(capsys: Capture, weights: Path, scan: Path, tmp_path: Path) -> None:
    options = ("--range", "20", "--sensor-height", "1.9", "--axes", "x: right, y: forward", "--score-threshold", "0.2")
    assert beambox(capsys, "detect", scan, "-m", weights, "-o", tmp_path, *options).status == 0
    found = package.load(weights, range=20, sensor_height=1.9, axes="x: right, y: forward")(scan)
    found = found[found.scores >= 0.2]
    written = detections_in(tmp_path / "scan.json")
    assert [row["name"] for row in written] == found.names
    assert np.allclose([row["x"] for row in written], found.boxes[:, 0], atol=1e-3)


def test_a_kitti_folder_becomes_a_submission(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    velodyne = kitti_folder(tmp_path / "kitti")
    out = tmp_path / "out"
    ran = beambox(capsys, "detect", tmp_path / "kitti", "-m", weights, "-o", out, "--format", "kitti,csv")
    assert ran.status == 0, ran.err
    assert sorted(p.name for p in out.iterdir()) == ["000000.csv", "000000.txt", "000001.csv", "000001.txt"]
    assert "points outside the camera's view are left out" in ran.err and ran.err.count("--view full") == 1
    lines = (out / "000000.txt").read_text(encoding="utf-8").splitlines()
    assert lines and all(len(line.split()) == 16 for line in lines)
    full = beambox(capsys, "detect", velodyne / "000000.bin", "-m", weights, "-o", out, "--view", "full")
    assert "left out" not in full.err


def test_an_empty_sweep_has_no_detections_and_is_no_error(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.bin").write_bytes(b"")
    ran = beambox(capsys, "detect", tmp_path / "empty.bin", "-m", weights, "-o", tmp_path)
    assert ran.status == 0 and "empty: no detections" in ran.out
    assert detections_in(tmp_path / "empty.json") == []


def test_points_out_of_range_warn_and_name_the_doctor(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    (street() + np.array([0, 900, 0, 0], dtype=np.float32)).tofile(tmp_path / "far.bin")
    ran = beambox(capsys, "detect", tmp_path / "far.bin", "-m", weights, "-o", tmp_path)
    assert ran.status == 0 and detections_in(tmp_path / "far.json") == []
    assert "none of its 16900 points lies in the region" in ran.err and "beambox doctor" in ran.err


def test_points_that_are_not_finite_are_dropped_and_counted(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    points = street()
    points[:9, 0] = np.nan
    points.tofile(tmp_path / "nan.bin")
    ran = beambox(capsys, "detect", tmp_path / "nan.bin", "-m", weights, "-o", tmp_path)
    assert ran.status == 0 and "dropped 9 of 16900 points that are NaN or infinite" in ran.err


def one_line(capsys: Capture, *words: object) -> str:
    """Run a command that must fail with one line on stderr and nothing on stdout."""
    ran = beambox(capsys, *words)
    assert ran.status == 2
    assert ran.out == ""
    line = ran.err.splitlines()[-1]
    assert line.startswith("beambox: ") and "Traceback" not in ran.err
    return line


def test_a_cut_sweep_is_refused(capsys: Capture, weights: Path, scan: Path, tmp_path: Path) -> None:
    scan.write_bytes(scan.read_bytes()[:-3])
    line = one_line(capsys, "detect", scan, "-m", weights, "-o", tmp_path / "out")
    assert "scan.bin must hold whole points of 4 float32 numbers" in line and "cut short" in line
    assert not (tmp_path / "out").exists()


def test_a_text_file_called_bin_is_refused(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    (tmp_path / "text.bin").write_text("x y z intensity\n1 2 3 0.5\n" * 20, encoding="utf-8")
    assert "is a text file" in one_line(capsys, "detect", tmp_path / "text.bin", "-m", weights, "-o", tmp_path)


def test_kitti_format_without_calibration_says_so_before_the_work(
    capsys: Capture, weights: Path, tmp_path: Path
) -> None:
    velodyne = kitti_folder(tmp_path, calib=False)
    line = one_line(capsys, "detect", velodyne, "-m", weights, "-o", tmp_path / "out", "-f", "json,kitti")
    assert "has no calibration" in line and "--format json or csv instead" in line
    assert not (tmp_path / "out").exists()


def test_unknown_weights_are_refused(capsys: Capture, scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beambox.zoo.shipped", lambda: {"pointpillars-sim": Path("x")})
    line = one_line(capsys, "detect", scan, "-m", "pointpillar-sim")
    assert line.endswith('(did you mean "pointpillars-sim"?)')


def test_weights_of_others_and_broken_ones_are_refused(
    capsys: Capture, scan: Path, weights: Path, tmp_path: Path
) -> None:
    from safetensors.torch import save_file
    from torch import zeros

    save_file({"w": zeros(1)}, tmp_path / "other.safetensors")
    assert "not one of beambox's" in one_line(capsys, "detect", scan, "-m", tmp_path / "other.safetensors")
    (tmp_path / "cut.safetensors").write_bytes(weights.read_bytes()[:5000])
    assert "cut.safetensors is not a readable weight file" in one_line(
        capsys, "detect", scan, "-m", tmp_path / "cut.safetensors"
    )


def test_an_output_folder_that_is_a_file_is_refused(capsys: Capture, weights: Path, scan: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("", encoding="utf-8")
    assert str(tmp_path / "out") in one_line(capsys, "detect", scan, "-m", weights, "-o", tmp_path / "out")


def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    capsys: Capture, weights: Path, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "out" / "scan.json"))

    monkeypatch.setattr("os.replace", full)
    line = one_line(capsys, "detect", scan, "-m", weights, "-o", tmp_path / "out")
    assert "No space left on device; free some space" in line
    assert not list((tmp_path / "out").iterdir())


def test_one_broken_sweep_does_not_stop_the_others(capsys: Capture, weights: Path, tmp_path: Path) -> None:
    for name in ("a", "c"):
        street().tofile(tmp_path / f"{name}.bin")
    (tmp_path / "b.bin").write_bytes(bytes(range(5)))
    ran = beambox(capsys, "detect", tmp_path, "-m", weights, "-o", tmp_path / "out")
    assert ran.status == 2
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.json", "c.json"]
    assert "skipped: " in ran.err and ran.err.endswith("1 of 3 sweeps could not be read; the others are done\n")


def test_an_interrupt_keeps_what_is_done(
    capsys: Capture, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        street().tofile(tmp_path / f"{name}.bin")
    real, calls = Detector.detect, []

    def detect(self: Detector, frames: list[package.Frame]) -> list[package.Detections]:
        calls.append(frames)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(self, frames)

    monkeypatch.setattr(Detector, "detect", detect)
    ran = beambox(capsys, "detect", tmp_path, "-m", weights, "-o", tmp_path / "out")
    assert ran.status == 130 and ran.err.splitlines()[-1].startswith("beambox: interrupted")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["a.json"]


@pytest.mark.parametrize("value", ["10,20", "wide", "1,2,3,4,5"])
def test_ranges_that_cannot_be_read_are_refused(capsys: Capture, weights: Path, scan: Path, value: str) -> None:
    assert "--range takes one number, or four" in one_line(capsys, "detect", scan, "-m", weights, "--range", value)


def test_without_a_model_the_free_weights_are_taken_and_named(capsys: Capture, scan: Path, tmp_path: Path) -> None:
    ran = beambox(capsys, "detect", scan, "--out", tmp_path / "out")
    assert ran.status == 0, ran.err
    assert "no --model given: pointpillars-sim" in ran.err
    assert json.loads((tmp_path / "out" / "scan.json").read_text())["model"] == "pointpillars-sim"
