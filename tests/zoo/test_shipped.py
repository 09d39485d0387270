"""The shipped weights: their cards are true where that can be recomputed, and they find what they should."""

import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from safetensors import safe_open
from safetensors.torch import save_file

import beambox
from beambox.detectors.renames import FIELDS
from beambox.detectors.weights import load_weights, read_weights, warn_of_licence
from beambox.infer.cards import read_card
from beambox.ops.rotated_iou import iou_bev
from beambox.simulate import simulate_frame
from beambox.train.recipes import find_recipe
from beambox.zoo import DEFAULT, shipped

NAMES = sorted(shipped())
ROOT = Path(__file__).resolve().parents[2]


def test_the_promised_weights_are_there() -> None:
    promised = {f"{detector}-{data}" for detector in ("pointpillars", "voxel_rcnn") for data in ("sim", "kitti")}
    assert promised | {"dennet-kitti"} <= set(NAMES)


def test_the_repository_stays_light() -> None:
    assert sum(path.stat().st_size for path in shipped().values()) < 25e6


def test_weights_with_former_names_are_shipped_under_the_present_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a training that began before names changed writes goes through benchmarks/ship.py."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from ship import ship

    with safe_open(str(shipped()["pointpillars-sim"]), "pt") as file:
        header = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    config = json.loads(header["config"])
    former = {new: old for old, new in FIELDS.items() if "." not in old} | {"max_voxels": "max_pillars"}
    config = {former.get(key, key): value for key, value in config.items()}
    anchors = {"bottom_z": "bottom", "matched_threshold": "matched", "unmatched_threshold": "unmatched"}
    config["anchors"] = [{anchors.get(k, k): v for k, v in one.items()} for one in config["anchors"]]
    assert "columns" in config and "bottom" in config["anchors"][0]
    save_file(tensors, tmp_path / "final.safetensors", {**header, "config": json.dumps(config)})
    shutil.copy(shipped()["pointpillars-sim"].with_suffix(".yaml"), tmp_path)
    stored = read_weights(ship(tmp_path / "final.safetensors", tmp_path / "pointpillars-sim.yaml"))
    assert "num_point_features" in stored.config and "bottom_z" in stored.config["anchors"][0]
    assert not set(former.values()) & stored.config.keys()
    assert all(torch.equal(stored.tensors[name], value) for name, value in tensors.items())


@pytest.mark.parametrize("name", NAMES)
def test_a_card_stands_beside_the_weights_and_inside_them(name: str) -> None:
    path = shipped()[name]
    beside = yaml.safe_load(path.with_suffix(".yaml").read_text(encoding="utf-8"))
    inside = read_card(path)
    assert inside.entries == beside
    for key in ("summary", "licence", "trained on", "recipe", "scores"):
        assert beside.get(key), f"the card of {name} must say `{key}`"
    assert find_recipe(beside["recipe"]).stem == name
    assert inside.detector == name.split("-", maxsplit=1)[0]


@pytest.mark.parametrize("name", NAMES)
def test_finds_the_cars_near_the_sensor_in_a_simulated_street(name: str) -> None:
    detector = beambox.load(name)
    found = wanted = 0
    for index in range(900_000, 900_006):
        frame = simulate_frame(5, index)
        assert frame.labels is not None and frame.labels.attributes is not None
        easy = (frame.labels.attributes.occlusion == 0) & (frame.labels.boxes[:, 0] < 25)
        cars = frame.labels[easy & torch.tensor([n == "Car" for n in frame.labels.names])]
        detections = detector(frame)
        boxes = detections[detections.scores > 0.3].boxes
        wanted += len(cars)
        if len(boxes) and len(cars):
            found += int((iou_bev(cars.boxes, boxes).amax(dim=1) > 0.5).sum())
    assert wanted >= 5
    assert found >= 0.8 * wanted


@pytest.mark.parametrize("name", NAMES)
def test_weights_that_are_not_free_say_so_once(name: str, caplog: pytest.LogCaptureFixture) -> None:
    warn_of_licence.cache_clear()
    for _ in range(2):
        load_weights(shipped()[name])
    licences = [record.getMessage() for record in caplog.records if "commercial" in record.getMessage()]
    assert len(licences) == (0 if name.endswith("-sim") else 1)
    assert all(name in text and "CC-BY-NC-SA-3.0" in text for text in licences)


def test_the_default_is_free_and_every_weight_file_stands_in_the_notice() -> None:
    assert read_card(shipped()[DEFAULT]).entries["licence"] == "Apache-2.0"
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    for name, path in shipped().items():
        paid = read_card(path).entries["licence"] != "Apache-2.0"
        assert (f"src/beambox/zoo/{name}.safetensors" in notice) == paid
        assert name in notice
