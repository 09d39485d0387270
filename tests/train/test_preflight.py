"""What would fail late, or learn nothing, is refused before the first step, in a sentence that names the cause."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from beambox.checks import BeamboxError
from beambox.data.source import FrameList
from beambox.detectors.catalog import build
from beambox.structures import Frame, Labels
from beambox.train import loop
from beambox.train.config import parse_recipe
from beambox.train.loop import train
from beambox.train.preflight import check_labels, check_recipe
from oracles.command_line import beambox
from oracles.tiny_training import FORKLIFT, OPTIONS, frames, tiny_kitti

CONFIG = build("pointpillars", OPTIONS).config


def recipe(**changes: Any) -> Any:
    source = {"kind": "kitti", "camera_view": False}
    return parse_recipe(
        {
            "name": "tiny",
            "detector": {"name": "pointpillars", "options": OPTIONS},
            "data": [source],
            "augment": {"sample": {"Car": 2}},
            "optim": {"iterations": 6, "batch": 2},
            "validation": {"source": {**source, "split": "val"}, "every": 3},
            "workers": 0,
            "precision": "float32",
            **changes,
        }
    )


def changed(edit: Callable[[Labels], Labels]) -> FrameList:
    """Five frames with their labels edited."""
    edited = []
    for frame in frames(5).frames:
        assert frame.labels is not None
        edited.append(replace(frame, labels=edit(frame.labels)))
    return FrameList(edited)


def sized(labels: Labels, length: float) -> Labels:
    boxes = labels.boxes.clone()
    boxes[:, 3] = length
    return Labels(boxes, labels.names)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            lambda labels: Labels(labels.boxes, ("car",)),
            r"none of the labels in the 5 frames of the training data is of the detector.s classes Car, Pedestrian, "
            r'Cyclist; they hold 5 car \(did you mean "Car"\?\)',
        ),
        (
            lambda labels: Labels(labels.boxes + torch.tensor([500.0, 0, 0, 0, 0, 0, 0]), labels.names),
            r"every Car in the 5 frames .* lies outside the detector's region, x 0 to 12.8, y -6.4 to 6.4, z -3 to 1 m",
        ),
        (
            lambda labels: sized(labels, 0.0),
            r"frame \d+ of the training data: a Car has a length, width or height of 0",
        ),
        (lambda _: Labels.empty(), "they hold no object"),
    ],
)
def test_labels_from_which_nothing_can_be_learnt(edit: Callable[[Labels], Labels], message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        check_labels(changed(edit), "training data", CONFIG.classes, CONFIG.grid, lambda _: None)


def test_one_good_frame_among_many_is_enough_and_lacking_classes_are_told() -> None:
    source = changed(lambda labels: labels).frames
    empty = [replace(frame, labels=Labels.empty()) for frame in source] * 10
    messages: list[str] = []
    check_labels(FrameList([*empty, source[0]]), "training data", CONFIG.classes, CONFIG.grid, messages.append)
    assert len(messages) == 1
    assert re.match(
        r"note: no Pedestrian, Cyclist in the \d+ frames of the training data looked at; they hold 1 Car", messages[0]
    )
    with pytest.raises(BeamboxError, match="the validation data hold no frame"):
        check_labels(FrameList([]), "validation data", CONFIG.classes, CONFIG.grid, messages.append)
    bare = FrameList([Frame(source[0].points, "a")])
    with pytest.raises(BeamboxError, match="frame a of the training data has no labels"):
        check_labels(bare, "training data", CONFIG.classes, CONFIG.grid, messages.append)


def own_class(**validation: Any) -> dict[str, Any]:
    section = recipe().validation.model_dump(mode="json")
    options = {**OPTIONS, "anchors": [FORKLIFT]}
    detector = {"name": "pointpillars", "options": options}
    return {"detector": detector, "augment": None, "validation": {**section, **validation}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"augment": {"sample": {"Carr": 15}}},
            r'augment.sample: the detector has no class "Carr" \(did you mean "Car"',
        ),
        (
            {"validation": {**recipe().validation.model_dump(mode="json"), "choose_by": "Bus"}},
            'validation.choose_by: the detector has no class "Bus"',
        ),
        (
            own_class(),
            "validation.iou: no IoU threshold is known for class 'Forklift'; give one, for example Forklift=0.5",
        ),
        (
            own_class(iou={"Forklfit": 0.5}),
            "validation.iou: an IoU threshold was given for 'forklfit', which is not scored",
        ),
    ],
)
def test_recipes_that_would_fail_late(changes: dict[str, Any], message: str) -> None:
    edited = recipe(**changes)
    with pytest.raises(BeamboxError, match=message):
        check_recipe(edited, build(edited.detector.name, edited.detector.options).config, 1)
    with pytest.raises(BeamboxError, match=r"batch = 2 frames cannot be shared evenly by 8 .*--set optim.batch=8"):
        check_recipe(recipe(), CONFIG, 8)
    check_recipe(
        recipe(**own_class(iou={"Forklift": 0.5})), build("pointpillars", {**OPTIONS, "anchors": [FORKLIFT]}).config, 2
    )


@pytest.mark.parametrize("changes", [{}, {"augment": {"sample": {"Carr": 15}}}, own_class()])
def test_nothing_is_cut_or_trained_before_the_checks(
    changes: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tiny_kitti(tmp_path / "data", name="car")
    monkeypatch.setattr(loop, "open_database", lambda *_: pytest.fail("objects were cut before the check"))
    with pytest.raises(BeamboxError):
        train(recipe(**changes), data, tmp_path / "run")
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".lock"]


def test_recipes_that_ship_pass_and_those_of_publications_say_float32() -> None:
    from beambox.train.recipes import list_recipes
    from beambox.train.stages import read_stages

    listed = list_recipes()
    assert len(listed) > 30
    for entry in listed:
        for edited in read_stages(entry.path):
            check_recipe(edited, build(edited.detector.name, edited.detector.options).config, 1)
            assert edited.precision == "float32" or entry.audience != "published", entry.name


def test_data_of_ones_own_are_given_by_their_yaml_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As docs/custom_data.md has it: `beambox train recipe.yaml --data data.yaml`."""
    root = tiny_kitti(tmp_path / "data")
    own = tmp_path / "data" / "training" / "own.yaml"
    (own.parent / "labels").mkdir()
    for frame in frames(5).frames:
        assert frame.labels is not None
        box = {"name": "Car", "box": frame.labels.boxes[0].tolist()}
        (own.parent / "labels" / f"{frame.id}.json").write_text(json.dumps([box]))
    own.write_text("points: velodyne/{frame}.bin\nlabels: labels/{frame}.json\nformat: json\nclasses: [Car]\n")
    source = {"kind": "custom", "path": "{data}", "split": "all"}
    edited = recipe(data=[source], augment=None, validation=None, optim={"iterations": 1, "batch": 2})
    (tmp_path / "r.yaml").write_text(yaml.safe_dump(edited.model_dump(mode="json")))
    ran = beambox(capsys, "train", tmp_path / "r.yaml", "--data", own, "--out", tmp_path / "run")
    assert ran.status == 0, ran.err
    assert (tmp_path / "run" / "final.safetensors").is_file()
    ran = beambox(capsys, "train", tmp_path / "r.yaml", "--data", root / "none.yaml", "--out", tmp_path / "other")
    assert ran.status == 2
    assert "--data: there is no file" in ran.err
