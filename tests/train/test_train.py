"""Whole runs from files: train, interrupt, resume, validate, evaluate."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.cli.main import main
from beambox.detectors.weights import read_weights
from beambox.train.config import Recipe, parse_recipe
from beambox.train.log import RunLog
from beambox.train.loop import train
from oracles.tiny_training import OPTIONS, tiny_kitti


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_kitti(tmp_path_factory.mktemp("kitti"))


def recipe(**changes: Any) -> Recipe:
    source = {"kind": "kitti", "camera_view": False}
    return parse_recipe(
        {
            "name": "tiny",
            "detector": {"name": "pointpillars", "options": OPTIONS},
            "data": [source],
            "augment": {"sample": {"Car": 2}, "flip_x": 0.5, "rotation": 0.1},
            "optim": {"iterations": 6, "batch": 2},
            "validation": {"source": {**source, "split": "val"}, "every": 3, "choose_by": "Car", "recalls": "all"},
            "workers": 0,
            "log_every": 2,
            "precision": "float32",
            **changes,
        }
    )


def test_run_writes_weights_scores_and_log(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = train(recipe(), data, tmp_path / "run")
    printed = capsys.readouterr().out
    assert outcome.finished
    assert outcome.step == 6
    assert outcome.score is not None
    assert outcome.weights == tmp_path / "run" / "best.safetensors"
    assert "object database: 5 Car" in printed
    assert printed.count("validation after step") == 2
    assert "3d all moderate Car" in printed
    card = read_weights(outcome.weights).card
    assert card["recipe"]["optim"]["iterations"] == 6
    assert set(card["validation"]) == {"Car", "Pedestrian", "Cyclist"}
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in logged if "lr" in line] == [2, 4, 6]
    assert [line["step"] for line in logged if "validation/Car" in line] == [3, 6]
    with pytest.raises(BeamboxError, match="holds a run already; go on with it by --resume"):
        train(recipe(), data, tmp_path / "run")


def test_interrupted_and_resumed_run_ends_with_the_same_weights(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    train(recipe(), data, tmp_path / "whole")

    def interrupt(self: RunLog, step: int) -> None:
        if step == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(RunLog, "progress", interrupt)
        outcome = train(recipe(), data, tmp_path / "cut")
    assert (outcome.finished, outcome.step) == (False, 4)
    assert "interrupted after step 4 of 6; the same command with --resume goes on" in capsys.readouterr().out
    assert train(recipe(workers=1), data, tmp_path / "cut", resume=True).finished
    whole, cut = (read_weights(tmp_path / name / "final.safetensors").tensors for name in ("whole", "cut"))
    assert all(torch.equal(whole[name], cut[name]) for name in whole)
    assert "the recipe has changed since, so the run is not the one it would have been: ['workers']" in (
        capsys.readouterr().out
    )


def test_weights_to_start_from_and_missing_folder(data: Path, tmp_path: Path) -> None:
    first = train(recipe(validation=None, augment=None), data, tmp_path / "first")
    detector = {"name": "pointpillars", "options": OPTIONS, "start_from": str(first.weights)}
    second = train(recipe(validation=None, augment=None, detector=detector), data, tmp_path / "second")
    assert second.finished
    with pytest.raises(BeamboxError, match=r'reads its data from "\{data\}"; say where that is with --data DIR'):
        train(recipe(), None, tmp_path / "third")


def test_train_and_evaluate_from_the_command_line(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import yaml

    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(recipe(validation=None).model_dump(mode="json")))
    run = tmp_path / "run"
    words = [
        "train",
        str(tmp_path / "tiny.yaml"),
        "--data",
        str(data),
        "--out",
        str(run),
        "--set",
        "optim.iterations=2",
    ]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
    capsys.readouterr()
    words = ["evaluate", str(run), "--data", str(data), "--view", "full", "--iou", "Car=0.7, Car=0.5"]
    words += ["--json", str(tmp_path / "scores.json"), "--results", str(tmp_path / "results")]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
    printed = capsys.readouterr().out
    assert "Car, IoU > 0.70, 2 / 2 / 2 objects" in printed
    assert "Car, IoU > 0.50, 2 / 2 / 2 objects" in printed
    numbers = json.loads((tmp_path / "scores.json").read_text())
    assert list(numbers) == ["Car", "Pedestrian", "Cyclist", "Car@0.5"]
    assert numbers["Car"]["iou"] == 0.7
    assert numbers["Car@0.5"]["iou"] == 0.5
    assert numbers["Car"].keys() - numbers["Car@0.5"].keys() == {"errors"}
    assert numbers["Car"]["errors"]["overall"]["objects"] == 2
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["000000.txt", "000001.txt"]
    with pytest.raises(SystemExit) as ended:
        main(["train", str(tmp_path / "tiny.yaml"), "--set", "optm.lr=1"])
    assert ended.value.code == 2
    assert 'unknown key "optm" (did you mean "optim"?)' in capsys.readouterr().err
