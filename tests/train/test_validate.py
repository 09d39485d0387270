"""Validation during a run: by ONCE's metric where the source has ONCE's layout, on simulated data of that layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build
from beambox.detectors.weights import read_weights
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.metrics.once_result import OnceResult
from beambox.simulate import Sensor, write_dataset
from beambox.train.config import Recipe, ValidationSection, parse_recipe, read_recipe
from beambox.train.loop import train
from beambox.train.sources import open_source
from beambox.train.validate import Validator, summarize_once
from oracles.command_line import beambox
from oracles.tiny_training import OPTIONS

QUICK = Sensor("quick", tuple(1.0 - 1.1 * k for k in range(16)), 1.0, 1.8)
GRID = {"minimum": [-12.8, -12.8, -3.0], "maximum": [12.8, 12.8, 1.0], "cell": [0.4, 0.4, 4.0]}
SOURCE = {"kind": "once", "path": "{data}"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("once")
    return write_dataset(folder / "data", 4, QUICK, seed=5, val_share=0.5, files="once", sequence_length=2)


def recipe(**validation: Any) -> Recipe:
    return parse_recipe(
        {
            "name": "tiny",
            "detector": {"name": "pointpillars", "options": {**OPTIONS, "grid": GRID}},
            "data": [SOURCE],
            "augment": {"sample": {"Car": 1}, "flip_x": 0.5},
            "optim": {"iterations": 2, "batch": 1},
            "validation": {"source": {**SOURCE, "split": "val"}, "every": 2, **validation},
            "workers": 0,
            "precision": "float32",
        }
    )


def test_run_on_simulated_once_data_is_validated_and_evaluated_by_its_rules(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(recipe(choose_by="Vehicle"), data, tmp_path / "run").finished
    printed = capsys.readouterr().out
    assert "validation after step 2: ONCE AP overall Vehicle" in printed
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    (scores,) = [line for line in logged if "validation/Vehicle" in line]
    assert {"validation/Pedestrian", "validation/Cyclist", "validation/mean"} <= scores.keys()
    card = read_weights(tmp_path / "run" / "best.safetensors").card
    assert card["validation"].keys() == {"Vehicle", "Pedestrian", "Cyclist", "mean"}
    words = ["--data", str(data), "--precision", "float32", "--json", str(tmp_path / "ap.json")]
    ran = beambox(capsys, "evaluate", str(tmp_path / "run"), *words)
    assert ran.status == 0
    assert "ONCE AP in percent, 2 frames" in ran.out
    numbers = json.loads((tmp_path / "ap.json").read_text())
    assert numbers["Vehicle"].pop("errors")["overall"].keys() >= {"objects", "matched", "x", "heading"}
    assert {name: {k: v for k, v in entry.items() if k != "errors"} for name, entry in numbers.items()} == (
        card["validation"]
    )
    assert {entry["precision"] for entry in numbers.values()} == {"float32"}


def test_classes_of_the_detector_alone_are_scored_and_choose(data: Path) -> None:
    cars = build("pointpillars", {**OPTIONS, "grid": GRID, "anchors": KITTI_ANCHORS[:1]})
    score = Validator(recipe(choose_by="Vehicle").validation, open_source(recipe().validation.source, data))(cars)
    assert set(score.scalars) == {"Vehicle", "mean"} and set(score.table) == {"Vehicle"}
    with pytest.raises(BeamboxError, match='the detector has no class "Cyclist"'):
        Validator(recipe(choose_by="Cyclist").validation, open_source(recipe().validation.source, data))(cars)


def test_the_wanted_class_at_all_distances_chooses() -> None:
    rows = ((40.0, 1.0, 2.0, 3.0), (20.0, 4.0, 5.0, 6.0), (30.0, 7.0, 8.0, 9.0))
    result = OnceResult(("Vehicle", "Pedestrian", "Cyclist"), (0.7, 0.3, 0.5), rows, ((1,) * 4,) * 3, 1)
    for name, value in (("mean", 30.0), ("Vehicle", 40.0), ("Cyclist", 30.0)):
        section = ValidationSection.model_validate({"source": SOURCE, "choose_by": name})
        score = summarize_once(result, section)
        assert score.value == pytest.approx(value)
    assert score.text == "ONCE AP overall Vehicle 40.00, Pedestrian 20.00, Cyclist 30.00, mean 30.00"
    assert score.table["Vehicle"]["30-50m"] == 2.0


def test_perfect_detections_score_100(data: Path) -> None:
    from beambox.data.once import OnceSource
    from beambox.infer.evaluate import score_once, scored_frames
    from beambox.structures import Detections

    found = []
    source = OnceSource(data, "val")
    for frame in source:
        labels = frame.labels
        classes = tuple(dict.fromkeys(labels.names))
        index = torch.tensor([classes.index(name) for name in labels.names])
        found.append((frame, Detections(labels.boxes, torch.ones(len(labels)), index, classes, frame.id)))
    score = summarize_once(score_once(scored_frames(found)), recipe().validation)
    assert score.scalars["Vehicle"] == pytest.approx(100)


@pytest.mark.parametrize(
    ("given", "pattern"),
    [
        (
            {"recalls": "all"},
            "validation: `recalls` is of KITTI's metric, and a source of kind once is scored by ONCE's",
        ),
        ({"level": "all"}, "`level` is of KITTI's metric"),
        (
            {"choose_by": "Car"},
            "`choose_by`: ONCE's metric has no class 'Car'.*; it merges Car, Bus and Truck into Vehicle",
        ),
        ({"iou": {"Cyclists": 0.5}}, r"`iou`: ONCE's metric has no class 'Cyclists' \(did you mean \"Cyclist\"\?\)"),
    ],
)
def test_options_of_the_other_metric_are_refused(given: dict[str, Any], pattern: str) -> None:
    with pytest.raises(BeamboxError, match=pattern):
        recipe(**given)


def test_a_recipe_written_down_can_be_read_again() -> None:
    run_recipe = recipe(choose_by="Pedestrian", iou={"Vehicle": 0.5})
    assert parse_recipe(run_recipe.model_dump(mode="json")) == run_recipe
    assert isinstance(Validator(run_recipe.validation, []), Validator)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ("pointpillars-once", [0.4, 0.4, 8.0]),
        ("hcnet-once", [0.4, 0.4, 1.0]),
        ("second-once", [0.2, 0.2, 0.2]),
        ("voxel_rcnn-once", [0.2, 0.2, 0.2]),
        ("dennet-once", [0.2, 0.2, 0.2]),
    ],
)
def test_recipes_for_once_train_on_simulated_data(
    name: str, cell: list[float], data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = f"{{minimum: [-12.8, -12.8, -5.0], maximum: [12.8, 12.8, 3.0], cell: {cell}}}"
    changes = ["optim.iterations=2", "optim.epochs=null", "optim.batch=1", "workers=0", f"detector.options.grid={grid}"]
    run_recipe = read_recipe(name, changes)
    assert train(run_recipe, data, tmp_path / "run").finished
    assert "ONCE AP overall Vehicle" in capsys.readouterr().out
    ran = beambox(capsys, "evaluate", str(tmp_path / "run"), "--data", str(data), "--published")
    assert ran.status == 0
    assert "DenNet (Photonics 2022), Table 3" in ran.out
