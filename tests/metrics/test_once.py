"""ONCE's metric: golden values, agreement with a plain-loop evaluator, its quirks, errors."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.metrics.once import (
    OnceBoxes,
    evaluate,
    evaluate_annotations,
    evaluate_boxes,
    gated_overlap,
    score_thresholds,
)
from beambox.metrics.once_result import PUBLISHED
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels
from oracles import once_ap

NAMES = ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")


def scene(rng: np.random.Generator) -> tuple[OnceBoxes, OnceBoxes]:
    """Make a random frame, with detections near the objects."""
    count = int(rng.integers(0, 12))
    names = rng.choice(NAMES, count)
    boxes = np.column_stack(
        (
            rng.uniform(-55, 55, (count, 2)),
            rng.uniform(-1, 0, count),
            rng.uniform([3.5, 1.6, 1.4], [4.8, 2.0, 1.9], (count, 3)),
            rng.uniform(-math.pi, math.pi, count),
        )
    )
    copies = rng.integers(0, count, 2 * count) if count else np.zeros(0, dtype=int)
    det = boxes[copies] + rng.normal(0, 0.1, (len(copies), 7))
    det[:, 6] += np.where(rng.random(len(copies)) < 0.1, math.pi, 0)
    det[:, 6] = (det[:, 6] + math.pi) % (2 * math.pi) - math.pi
    found_names = np.where(rng.random(len(copies)) < 0.8, names[copies], rng.choice(NAMES, len(copies)))
    scores = rng.uniform(0, 1, len(copies)).round(2)  # so that scores tie
    return OnceBoxes(tuple(names), boxes, np.zeros(count)), OnceBoxes(tuple(found_names), det, scores)


@pytest.mark.parametrize("seed", range(4))
def test_once_agrees_with_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = [scene(rng) for _ in range(12)]
    result = evaluate_boxes(pairs)
    plain = [(t.names, t.boxes.tolist(), f.names, f.boxes.tolist(), f.scores.tolist()) for t, f in pairs]
    for name, row in zip(result.classes, result.ap):
        for band, value in enumerate(row):
            assert value == pytest.approx(once_ap.average_precision(plain, name, band)), f"{name} {band}"
    assert max(map(max, result.ap)) > 0


def test_thresholds_repeat_where_objects_are_few() -> None:
    thresholds = score_thresholds(np.array([0.9, 0.8, 0.7, 0.6]), 4).tolist()
    assert thresholds == [0.9] * 19 + [0.8] * 13 + [0.7] * 12 + [0.6] * 7
    assert len(score_thresholds(1 - np.arange(80) / 200, 100)) == 41


def cars(number: int) -> Labels:
    boxes = torch.tensor([[0.1 + 6.0 * i, 0, -1, 4, 1.8, 1.5, 0.3] for i in range(number)]).reshape(-1, 7)
    return Labels(boxes, ("Car", "Bus", "Truck", "Car", "Car")[:1] * number)


def det(labels: Labels, scores: list[float]) -> Detections:
    size = len(scores)
    return Detections(labels.boxes[:size], torch.tensor(scores), torch.zeros(size, dtype=torch.int64), ("Car",))


def test_perfect_detections_of_four_objects_give_100() -> None:
    labels = cars(4)
    result = evaluate([(labels, det(labels, [0.9, 0.8, 0.7, 0.6]))])
    assert result.to_json()["Vehicle"]["overall"] == pytest.approx(100)
    assert result.to_json()["mean"]["overall"] == pytest.approx(100 / 3, abs=1e-3)


def test_eighty_of_a_hundred_give_80() -> None:
    labels = cars(100)
    result = evaluate([(labels, det(labels, (1 - torch.arange(80) / 200).tolist()))])
    assert result.ap[0][0] == pytest.approx(80)


def test_car_bus_and_truck_match_each_other_only_when_merged() -> None:
    labels = cars(3)
    other = Detections(labels.boxes, torch.ones(3), torch.tensor([0, 1, 1]), ("Truck", "Bus"))
    assert evaluate([(labels, other)]).ap[0][0] == pytest.approx(100)
    assert evaluate([(labels, other)], five_classes=True).to_json()["Car"]["overall"] == 0


def test_classes_that_a_detector_does_not_know_are_not_scored() -> None:
    names = ("Car", "Truck", "Pedestrian")
    boxes = torch.tensor([[5.0 + 6 * k, 0, 0, 2, 1, 1, 0] for k in range(3)])
    labels = Labels(boxes, names)
    det = Detections(boxes[:1], torch.ones(1), torch.zeros(1, dtype=torch.int64), ("Car",), "")
    everything = evaluate([(labels, det)])
    assert everything.classes == ("Vehicle", "Pedestrian", "Cyclist") and "mean" in everything.to_json()
    cars = evaluate([(labels, det)], known=["Car"])
    assert cars.classes == ("Vehicle",) and cars.ap[0] == everything.ap[0], "trucks count as vehicles all the same"
    assert set(cars.to_json()) == {"Vehicle"}, "the mean of a part is not the benchmark's"
    with pytest.raises(BeamboxError, match="the detector knows Van"):
        evaluate([(labels, det)], known=["Van"])


def test_opposed_headings_and_far_centers_do_not_overlap() -> None:
    box = np.array([[10.0, 0, -1, 4, 2, 1.5, 3.1]])
    assert gated_overlap(box, box)[0, 0] == pytest.approx(1)
    assert gated_overlap(box, box + np.array([0, 0, 0, 0, 0, 0, -6.2]))[0, 0] > 0.9  # 3.1 and -3.1 differ by 0.08
    assert gated_overlap(box, box - np.array([0, 0, 0, 0, 0, 0, math.pi]))[0, 0] == 0
    long = np.array([[10.0, 0, -1, 60, 2, 3, 0.0]])
    assert gated_overlap(long, long + np.array([4.9, 0, 0, 0, 0, 0, 0]))[0, 0] > 0.8
    assert gated_overlap(long, long + np.array([5.1, 0, 0, 0, 0, 0, 0]))[0, 0] == 0


def test_boxes_turn_clockwise_unless_told_otherwise() -> None:
    gt = np.array([[0.0, 0, 0, 4, 1, 1, math.pi / 4]])
    ahead = gt + np.array([0.7, 0.7, 0, 0, 0, 0, 0])  # 0.99 m along the true heading
    assert gated_overlap(gt, ahead, true_rotation=True)[0, 0] > 0.5
    assert gated_overlap(gt, ahead)[0, 0] < 0.05


def test_box_of_another_class_outside_the_band_absorbs_a_detection() -> None:
    gt = OnceBoxes(("Pedestrian", "Car"), np.array([[29.9, 0, 0, 1, 1, 2, 0], [60.0, 0, 0, 4, 2, 2, 0]]), np.zeros(2))
    names, boxes = ("Car", "Car"), np.array([[29.9, 0, 0, 1, 1, 2, 0], [60.0, 0, 0, 4, 2, 2, 0]])
    result = evaluate_boxes([(gt, OnceBoxes(names, boxes, np.array([0.9, 0.5])))])
    vehicle = dict(zip(("overall", "0-30m", "30-50m", "50m-inf"), result.ap[0]))
    assert vehicle["overall"] == pytest.approx(50)  # the car at 29.9 m is a false positive
    assert vehicle["50m-inf"] == pytest.approx(100)  # there the pedestrian, out of the band, takes it


def test_table_keeps_published_rows_apart() -> None:
    labels = cars(2)
    result = evaluate([(labels, det(labels, [0.9, 0.8]))])
    plain, both = result.table("ours"), result.table("ours", published=True)
    assert "published" not in plain and "no objects, scored 0" in plain
    assert both.index("ours") < both.index("not measured here") < both.index("DenNet         |   80.24")
    means = {row.name: round((row.vehicle[0] + row.pedestrian[0] + row.cyclist[0]) / 3, 3) for row in PUBLISHED}
    assert (means["Voxel R-CNN"], means["DenNet"]) == (56.347, 60.503)
    assert all(abs(means[row.name] - row.mean) < 0.25 for row in PUBLISHED)


def frame(name: str, **lists: list) -> dict:
    return {"frame_id": name, "names": [], "boxes_3d": [], **lists}


def write(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_annotations_in_one_file_or_two(tmp_path: Path) -> None:
    box = [10.0, 0, -1, 4, 2, 1.5, 0]
    gt = [frame("a", names=["Car"], boxes_3d=[box]), frame("b")]
    predictions = [frame("b", scores=[]), frame("a", names=["Car"], boxes_3d=[box], scores=[0.5])]
    both = evaluate_annotations(write(tmp_path / "f.json", {"ground_truth": gt, "predictions": predictions}))
    apart = evaluate_annotations(write(tmp_path / "g.json", gt), write(tmp_path / "p.json", predictions))
    assert both == apart
    assert both.ap[0][0] == pytest.approx(100)


def test_errors_say_file_and_key(tmp_path: Path) -> None:
    gt = [frame("a", names=["Car"], boxes_3d=[[1, 2, 3, 4, 5, 6, 0]])]
    with pytest.raises(MissingFileError, match="does not exist"):
        evaluate_annotations(tmp_path / "none.json")
    (tmp_path / "x.json").write_text("{", encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"x\.json is not valid JSON"):
        evaluate_annotations(tmp_path / "x.json")
    path = write(tmp_path / "y.json", {"ground_truths": gt})
    with pytest.raises(BeamboxError, match=r"y\.json: the key 'ground_truth' is missing \(did you mean"):
        evaluate_annotations(path)
    path = write(tmp_path / "z.json", {"ground_truth": gt, "predictions": []})
    with pytest.raises(BeamboxError, match="1 of 1 annotated frames have no predictions, the first is a; write"):
        evaluate_annotations(path)
    path = write(tmp_path / "z.json", {"ground_truth": gt, "predictions": [frame("a")]})
    with pytest.raises(BeamboxError, match="predictions of frame a: the key 'scores' is missing"):
        evaluate_annotations(path)
    path = write(tmp_path / "z.json", {"ground_truth": gt, "predictions": [frame("a", names=["Car"], scores=[])]})
    with pytest.raises(BeamboxError, match="1 names, 0 boxes_3d, 0 scores"):
        evaluate_annotations(path)
    with pytest.raises(BeamboxError, match="threshold was given for 'Car', which is not scored"):
        evaluate_boxes([(OnceBoxes((), np.zeros((0, 7)), np.zeros(0)),) * 2], min_overlap={"Car": 0.5})
