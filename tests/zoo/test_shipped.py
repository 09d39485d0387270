"""The shipped weights: their cards are true where that can be recomputed, and they find what they should."""

from pathlib import Path

import pytest
import torch
import yaml

import beambox
from beambox.infer.cards import read_card
from beambox.ops.rotated_iou import iou_bev
from beambox.simulate import simulate_frame
from beambox.zoo import shipped

NAMES = sorted(shipped())
ROOT = Path(__file__).resolve().parents[2]


def test_the_promised_weights_are_there() -> None:
    promised = {f"{detector}-{data}" for detector in ("pointpillars", "voxel_rcnn") for data in ("sim", "kitti")}
    assert promised | {"dennet-kitti"} <= set(NAMES)


def test_the_repository_stays_light() -> None:
    assert sum(path.stat().st_size for path in shipped().values()) < 25e6


@pytest.mark.parametrize("name", NAMES)
def test_a_card_stands_beside_the_weights_and_inside_them(name: str) -> None:
    path = shipped()[name]
    beside = yaml.safe_load(path.with_suffix(".yaml").read_text(encoding="utf-8"))
    inside = read_card(path)
    assert inside.said == beside
    for key in ("summary", "licence", "trained on", "recipe", "scores"):
        assert beside.get(key), f"the card of {name} must say `{key}`"
    assert (ROOT / beside["recipe"]).is_file()
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
