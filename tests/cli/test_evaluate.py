"""`beambox evaluate` and `score`: one way to write options, one form of JSON, checks before the work."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from beambox.detectors.catalog import build
from beambox.detectors.weights import save_weights
from beambox.infer import evaluate as evaluate_module
from oracles.command_line import beambox
from oracles.tiny_training import FORKLIFT, OPTIONS, tiny_kitti


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_kitti(tmp_path_factory.mktemp("kitti"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(path, build("pointpillars", OPTIONS))
    return path


def words(weights: Path, data: Path, *more: object) -> list[str]:
    return ["evaluate", str(weights), "--data", str(data), "--precision", "float32", *map(str, more)]


def test_a_class_of_ones_own_is_evaluated_with_its_overlap(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_weights(tmp_path / "fork.safetensors", build("pointpillars", {**OPTIONS, "anchors": [FORKLIFT]}))
    ran = beambox(capsys, *words(tmp_path / "fork.safetensors", kitti, "--iou", "Forklift=0.5"))
    assert ran.status == 0
    assert "Forklift, IoU > 0.50" in ran.out
    monkeypatch.setattr(evaluate_module, "detect_frames", lambda *_, **__: pytest.fail("detected before the check"))
    ran = beambox(capsys, *words(tmp_path / "fork.safetensors", kitti))
    assert ran.status == 2
    assert "no IoU threshold is known for class 'Forklift'; give one, for example Forklift=0.5" in ran.err
    ran = beambox(capsys, *words(tmp_path / "fork.safetensors", kitti, "--iou", "Forklifts=0.5"))
    assert ran.status == 2
    assert "'forklifts', which is not scored (did you mean \"forklift\"?)" in ran.err


def test_json_has_one_form_and_names_overlap_and_precision(
    kitti: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "ap.json"
    forms = []
    for more in (
        [],
        ["--iou", "Car=0.5"],
        ["--iou", "Car=0.5, Cyclist=0.25"],
        ["--iou", "Car=0.5", "--iou", "Cyclist=0.25"],
    ):
        ran = beambox(capsys, *words(weights, kitti, "--json", file, "--classes", "Car, Cyclist", *more))
        assert ran.status == 0
        assert "detected in float32" in ran.out
        assert "Car: ATE" in ran.out
        forms.append(json.loads(file.read_text()))
    assert all(form.keys() == {"Car", "Cyclist"} for form in forms)
    assert all(form["Car"].keys() == forms[0]["Car"].keys() for form in forms)
    assert [form["Car"]["iou"] for form in forms] == [0.7, 0.5, 0.5, 0.5]
    assert [form["Cyclist"]["iou"] for form in forms] == [0.5, 0.5, 0.25, 0.25]
    assert {entry["precision"] for form in forms for entry in form.values()} == {"float32"}


def test_kept_detections_are_scored_again_without_the_network(
    kitti: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from beambox.infer.predictor import Detector

    file = tmp_path / "kept.jsonl"
    ran = beambox(capsys, *words(weights, kitti, "--keep", file))
    assert ran.status == 0
    monkeypatch.setattr(Detector, "detect", lambda *_: pytest.fail("detected again"))
    again = beambox(capsys, *words(weights, kitti, "--keep", file))
    assert again.out == ran.out
    other = beambox(capsys, *words(weights, kitti, "--keep", file, "--score-threshold", "0.5"))
    assert other.status == 2
    assert "made otherwise: score_threshold was 0.0, is 0.5" in other.err


def test_what_cannot_be_done_is_refused_before_detecting(
    kitti: Path, weights: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(evaluate_module, "detect_frames", lambda *_, **__: pytest.fail("detected before the check"))
    ran = beambox(capsys, *words(weights, kitti, "--published"))
    assert ran.status == 2
    assert "--published prints the rows of a table on ONCE" in ran.err
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "a.bin").write_bytes((kitti / "training/velodyne/000000.bin").read_bytes())
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.json").write_text('[{"name": "Car", "box": [5, 0, -1, 4, 2, 1.5, 0]}]')
    (tmp_path / "own.yaml").write_text(
        "points: velodyne/{frame}.bin\nlabels: labels/{frame}.json\nformat: json\nclasses: [Car]\n"
    )
    ran = beambox(capsys, *words(weights, tmp_path / "own.yaml", "--split", "all", "--results", tmp_path / "out"))
    assert ran.status == 2
    assert "--keep FILE" in ran.err
    assert not (tmp_path / "out").exists()


def once_file(folder: Path, truth: str, found: str, **entry: object) -> Path:
    box = {"boxes_3d": [[10 + 6 * i, 0, -1, 4, 2, 1.5, 0] for i in range(3)]}
    content = {
        "ground_truth": [{"frame_id": "1", "names": [truth] * 3, **box}],
        "predictions": [{"frame_id": "1", "names": [found] * 3, "scores": [0.9, 0.8, 0.7], **box}],
    }
    (folder / "o.json").write_text(json.dumps(content))
    return folder / "o.json"


def test_once_takes_names_in_any_case_and_tells_of_those_it_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "ap.json"
    beambox(capsys, "score", "once", "--annotations", str(once_file(tmp_path, "car", "CAR")), "--json", str(file))
    assert json.loads(file.read_text())["Vehicle"] == {
        "iou": 0.7, "overall": 100.0, "0-30m": 100.0, "30-50m": 0.0, "50m-inf": 0.0
    }  # fmt: skip
    ran = beambox(capsys, "score", "once", "--annotations", str(once_file(tmp_path, "Cyclist", "Bicycle")))
    assert 'left out, ONCE has no such class: Bicycle, 3 boxes (did you mean "Cyclist"?)' in ran.out
    annotations = str(once_file(tmp_path, "Car", "Car"))
    ran = beambox(
        capsys,
        "score",
        "once",
        "--annotations",
        annotations,
        "--classes",
        "Vehicle",
        "--iou",
        "Vehicle=0.9,Vehicle=0.5",
        "--json",
        str(file),
    )
    assert {name: entry["iou"] for name, entry in json.loads(file.read_text()).items()} == {
        "Vehicle": 0.9,
        "Vehicle@0.5": 0.5,
    }
    assert "Cyclist" not in ran.out


@pytest.mark.parametrize("part", ["ground_truth", "predictions"])
def test_frames_that_come_twice_are_refused(part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = once_file(tmp_path, "Car", "Car")
    content = json.loads(path.read_text())
    content[part] *= 2
    path.write_text(json.dumps(content))
    ran = beambox(capsys, "score", "once", "--annotations", str(path))
    assert ran.status == 2
    assert "must hold each frame once, but holds 1 again" in ran.err


def test_a_list_that_names_a_frame_twice_is_refused(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "list.txt").write_text("000000\n000000\n")
    labels = str(kitti / "training" / "label_2")
    (tmp_path / "results").mkdir()
    command = ("score", "kitti", "--labels", labels, "--results", str(tmp_path / "results"), "--allow-missing")
    ran = beambox(capsys, *command, "--frame-list", str(tmp_path / "list.txt"))
    assert ran.status == 2
    assert "must name each frame once, but names 000000 again" in ran.err


def test_dont_care_is_one_region_in_any_case() -> None:
    from beambox.data.kitti_text import parse_labels
    from beambox.geometry.calibration import Calibration
    from beambox.metrics.kitti_objects import parse_objects

    calibration = Calibration(torch.eye(3, 4), torch.eye(3), torch.eye(3, 4))
    for name in ("DontCare", "dontcare", "DONTCARE"):
        line = f"{name} -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10"
        assert len(parse_labels(line, calibration).ignored_image) == 1
        assert len(parse_objects(line, "", scored=False).ignored_image) == 1
