"""KITTI's metric: golden values, agreement with a plain-loop evaluator, properties, errors."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beambox.checks import BeamboxError, MissingFileError
from beambox.geometry.calibration import Calibration
from beambox.metrics.kitti import KittiResult, evaluate, evaluate_files, score_thresholds
from beambox.structures.detections import Detections
from beambox.structures.labels import ImageAttributes, Labels
from oracles import kitti_ap

CALIBRATION = Calibration(
    p2=torch.tensor([[720.0, 0, 610, 45], [0, 720, 173, 0.2], [0, 0, 1, 0.003]]),
    r0=torch.eye(3),
    velo_to_cam=torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]),
)
NAMES = ("Car", "Van", "Pedestrian", "Person_sitting", "Cyclist", "Truck")


def line(rng: np.random.Generator, name: str, near: str | None = None, score: float | None = None) -> str:
    """Write one random object, or one near another."""
    if near is None:
        x, z, ry = rng.uniform(-12, 12), rng.uniform(6, 40), rng.uniform(-math.pi, math.pi)
        h, w, length = rng.uniform(1.4, 2.0), rng.uniform(0.6, 2.0), rng.uniform(0.8, 4.5)
        y = 1.7
    else:
        n = [float(v) for v in near.split()[1:15]]
        h, w, length, x, y, z, ry = (v + rng.normal(0, 0.06) for v in n[7:14])
    u, v, tall = 610 + 720 * x / z, 173 + 720 * y / z, 720 * h / z
    wide = tall * rng.uniform(0.8, 1.3)
    truncated, occluded = (
        (-1, -1) if score is not None else (round(rng.choice([0, 0.1, 0.2, 0.4, 0.6]), 2), rng.integers(4))
    )
    alpha = math.remainder(ry - math.atan2(x, z) + rng.normal(0, 0.3), 2 * math.pi)
    values = (alpha, u - wide / 2, v - tall, u + wide / 2, v, h, w, length, x, y, z, ry)
    text = f"{name} {truncated} {occluded} " + " ".join(f"{value:.4f}" for value in values)
    return text if score is None else f"{text} {score:.2f}"  # two decimals, so that scores tie


def scene(rng: np.random.Generator) -> tuple[str, str]:
    """Write the label and the result file of a random frame."""
    labels = [line(rng, str(rng.choice(NAMES))) for _ in range(rng.integers(0, 7))]
    results = []
    for near in labels:
        for _ in range(rng.integers(0, 3)):
            name = near.split()[0] if rng.random() < 0.8 else str(rng.choice(NAMES))
            results.append(line(rng, name, near, rng.random()))
    results += [line(rng, str(rng.choice(NAMES)), score=rng.random()) for _ in range(rng.integers(0, 4))]
    left, top = rng.uniform(0, 900), rng.uniform(100, 200)
    labels.append(f"DontCare -1 -1 -10 {left} {top} {left + 250} {top + 120} -1 -1 -1 -1000 -1000 -1000 -10")
    return "\n".join(labels), "\n".join(results)


def write(folder: Path, frames: list[tuple[str, str]]) -> tuple[Path, Path]:
    labels, results = folder / "label_2", folder / "results"
    for into, column in ((labels, 0), (results, 1)):
        into.mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(frames):
            (into / f"{number:06d}.txt").write_text(frame[column], encoding="utf-8")
    return labels, results


@pytest.mark.parametrize("seed", range(6))
def test_kitti_agrees_with_plain_loops(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    frames = [scene(rng) for _ in range(10)]
    result = evaluate_files(*write(tmp_path, frames), min_overlap={"Car": 0.6, "Pedestrian": 0.4})
    checked = 0
    for name, minimum in (("Car", 0.6), ("Pedestrian", 0.4), ("Cyclist", 0.5)):
        ours = result[name]
        for metric, averages in (("3d", ours.box3d), ("bev", ours.bev), ("2d", ours.image)):
            for level, average in enumerate(averages):
                if ours.objects[level] == 0:
                    assert math.isnan(average.r40)
                    continue
                precision, orientation, points = kitti_ap.curves(frames, name, metric, level, minimum)
                np.testing.assert_allclose(average.curve, precision, atol=1e-9)
                assert average.r40 == pytest.approx(100 * sum(precision[1:]) / 40)
                assert average.r11 == pytest.approx(100 * sum(precision[::4]) / 11)
                assert average.all_points == pytest.approx(kitti_ap.all_point_area(points))
                if metric == "2d":
                    np.testing.assert_allclose(ours.orientation[level].curve, orientation, atol=1e-9)
                checked += max(precision) > 0
    assert checked > 3


def test_thresholds_of_four_objects() -> None:
    assert score_thresholds(np.array([0.9, 0.8, 0.7, 0.6]), 4).tolist() == [0.9, 0.8, 0.7, 0.6]


def test_thresholds_of_a_hundred_objects() -> None:
    scores = 1 - np.arange(100) / 200
    thresholds = score_thresholds(scores, 100)
    assert len(thresholds) == 41
    np.testing.assert_allclose(thresholds[:5], [1.0, 0.99, 0.98, 0.965, 0.955])
    np.testing.assert_allclose(thresholds[-3:], [0.53, 0.515, 0.505])
    assert len(score_thresholds(scores[:80], 100)) == 33


def cars(number: int, first: int = 0) -> Labels:
    boxes = torch.tensor([[10.0 + 6 * i, 0, -1, 4, 1.8, 1.5, 0.1] for i in range(first, first + number)])
    return Labels(boxes.reshape(-1, 7), ("Car",) * number)


def det(labels: Labels, scores: torch.Tensor | list[float]) -> Detections:
    scores = torch.as_tensor(scores, dtype=torch.float32)
    return Detections(labels.boxes, scores, torch.zeros(len(labels), dtype=torch.int64), ("Car",))


def simple(labels: list[Labels], detections: list[Detections]) -> KittiResult:
    return evaluate([(a, b, None) for a, b in zip(labels, detections)], no_difficulty=True)


def test_four_objects_all_found_are_capped_except_in_all() -> None:
    labels = cars(4)
    average = simple([labels], [det(labels, [0.9, 0.8, 0.7, 0.6])])["Car"].box3d[0]
    assert average.r40 == pytest.approx(7.5)
    assert average.r11 == pytest.approx(9.0909, abs=1e-3)
    assert average.all_points == pytest.approx(100)


def test_a_hundred_objects_all_found_give_100_and_eighty_give_80() -> None:
    labels = cars(100)
    everything = det(labels, 1 - torch.arange(100) / 200)
    full = simple([labels], [everything])["Car"]
    assert [a.r40 for a in full.bev] == pytest.approx([100])
    part = simple([labels], [everything[:80]])["Car"].box3d[0]
    assert (part.r40, part.r11, part.all_points) == pytest.approx((80.0, 81.8182, 80.0), abs=1e-3)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_ap_stays_within_bounds_and_a_late_false_positive_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [cars(int(rng.integers(1, 12)), int(rng.integers(0, 5))) for _ in range(4)]
    results = []
    for labels in frames:
        shifted = labels.boxes + torch.tensor(rng.normal(0, 0.12, labels.boxes.shape), dtype=torch.float32)
        scores = torch.tensor(rng.uniform(0.2, 1, len(labels)))
        results.append(det(Labels(shifted, labels.names), scores))
    before = simple(frames, results)["Car"].box3d[0]
    for value in (before.r40, before.r11, before.all_points):
        assert 0 <= value <= 100 + 1e-9
    assert list(before.curve) == sorted(before.curve, reverse=True)
    stray = torch.tensor([[-30.0, 20, -1, 4, 2, 1.5, 0]])
    last = results[0]
    results[0] = Detections(
        torch.cat((last.boxes, stray)),
        torch.cat((last.scores, torch.tensor([0.01]))),
        torch.zeros(len(last) + 1).long(),
        ("Car",),
    )
    after = simple(frames, results)["Car"].box3d[0]
    assert after.curve == pytest.approx(before.curve)
    assert after.all_points == pytest.approx(before.all_points)


def camera_labels(labels: Labels, occlusion: int = 0) -> Labels:
    camera = CALIBRATION.to_camera(labels.boxes, (1242, 375))
    size = len(labels)
    attributes = ImageAttributes(torch.zeros(size), torch.full((size,), occlusion), camera.alpha, camera.image)
    return Labels(labels.boxes, labels.names, attributes)


def test_memory_and_files_agree(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    frames, texts = [], []
    for _ in range(6):
        labels = camera_labels(cars(6), int(rng.integers(3)))
        near = labels.boxes + torch.tensor(rng.normal(0, 0.1, (6, 7)), dtype=torch.float32)
        detections = det(Labels(near, labels.names), rng.uniform(0, 1, 6).round(3))
        frames.append((labels, detections, CALIBRATION))
        camera = CALIBRATION.to_camera(labels.boxes)
        assert labels.attributes is not None
        rows = torch.cat(
            (
                labels.attributes.alpha[:, None],
                labels.attributes.image,
                camera.size,
                camera.location,
                camera.rotation_y[:, None],
            ),
            1,
        )
        hidden = int(labels.attributes.occlusion[0])
        text = "\n".join(f"Car 0 {hidden} " + " ".join(map(str, row)) for row in rows.tolist())
        texts.append((text, detections.to_kitti(CALIBRATION, (1242, 375))))
    ours = evaluate(frames, ["Car"])["Car"]
    read = evaluate_files(*write(tmp_path, texts), classes=["Car"])["Car"]
    assert ours.objects == read.objects
    for a, b in zip(
        (*ours.box3d, *ours.bev, *ours.image, *ours.orientation),
        (*read.box3d, *read.bev, *read.image, *read.orientation),
    ):
        assert a.curve == pytest.approx(b.curve, abs=1e-4)


def test_python_port_ignores_a_label_of_exactly_the_minimum_height(tmp_path: Path) -> None:
    text = "Car 0 0 0 100 100 200 125 1.5 1.6 4 0 1.7 30 0"
    folders = write(tmp_path, [(text, f"{text} 0.9")])
    assert evaluate_files(*folders, classes=["Car"])["Car"].objects == (0, 1, 1)
    assert evaluate_files(*folders, classes=["Car"], python_port=True)["Car"].objects == (0, 0, 0)


def test_unknown_heading_leaves_orientation_out(tmp_path: Path) -> None:
    label = "Car 0 0 0.5 100 100 200 180 1.5 1.6 4 0 1.7 20 0"
    folders = write(tmp_path, [(label, label.replace("0.5", "-10", 1) + " 0.9")])
    result = evaluate_files(*folders, classes=["Car"])
    assert math.isnan(result["Car"].orientation[0].r40)
    assert result.to_json()["Car"]["aos"] == {key: [None] * 3 for key in ("R40", "R11", "all")}
    assert result["Car"].image[0].all_points == pytest.approx(100)


def test_json_and_table_name_the_protocol(tmp_path: Path) -> None:
    label = "Car 0 0 0.5 100 100 200 180 1.5 1.6 4 0 1.7 20 0"
    result = evaluate_files(*write(tmp_path, [(label, f"{label} 0.9")]))
    record = result.to_json()
    assert list(record) == ["Car", "Pedestrian", "Cyclist"]
    assert list(record["Car"]) == ["iou", "3d", "bev", "2d", "aos"]
    assert list(record["Car"]["3d"]) == ["R40", "R11", "all"]
    assert all(len(values) == 3 for values in record["Car"]["3d"].values())
    table = result.table()
    assert "easy, moderate, hard" in table and "papers quote 3d, moderate" in table
    assert "fewer than 41 objects: R40 and R11 of Car are capped, read `all`" in table
    assert "the labels have no Cyclist" in table


def test_nothing_found_is_zero_and_no_objects_is_unknown() -> None:
    result = simple([cars(3)], [Detections.empty(("Car",))])
    assert result["Car"].box3d[0].r40 == 0
    result = simple([Labels.empty()], [det(cars(2), [0.5, 0.4])])
    assert math.isnan(result["Car"].box3d[0].r40)
    assert result.to_json()["Car"]["3d"]["all"] == [None]
    assert "the labels have no Car" in result.table() and "capped" not in result.table()


def test_labels_without_image_boxes_are_not_called_absent(tmp_path: Path) -> None:
    label = "Car 0 0 0.5 0 0 0 0 1.5 1.6 4 0 1.7 20 0"
    folders = write(tmp_path, [(f"{label}\n{label}", f"{label} 0.9")])
    table = evaluate_files(*folders, classes=["Car", "Cyclist"]).table()
    assert "the labels have 2 Car, but none that KITTI's levels count" in table and "--no-difficulty" in table
    assert "the labels have no Car" not in table and "the labels have no Cyclist" in table
    every = evaluate_files(*folders, classes=["Car"], no_difficulty=True)
    assert every["Car"].objects == (2,) and every["Car"].labeled == 2


def test_errors_say_what_to_do(tmp_path: Path) -> None:
    labels, results = write(tmp_path, [scene(np.random.default_rng(1)) for _ in range(2)])
    (results / "000001.txt").unlink()
    with pytest.raises(
        MissingFileError, match=r"1 of 2 frames have no result file .* 000001\.txt; write an empty file"
    ):
        evaluate_files(labels, results)
    evaluate_files(labels, results, allow_missing=True)
    with pytest.raises(MissingFileError, match="the folder of labels"):
        evaluate_files(tmp_path / "none", results)
    with pytest.raises(MissingFileError, match="frame 7 has no label file"):
        evaluate_files(labels, results, ["7"], allow_missing=True)
    (results / "000001.txt").write_text("Car 1 2 3\n", encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"000001.txt, line 1: a result line has 16 columns .* got 4"):
        evaluate_files(labels, results)
    (results / "000001.txt").write_text("Car " + "x " * 15, encoding="utf-8")
    with pytest.raises(BeamboxError, match="line 1: expected numbers after the type"):
        evaluate_files(labels, results)
    (results / "000001.txt").write_text("Car " + "nan " * 15, encoding="utf-8")
    with pytest.raises(BeamboxError, match="line 1: expected finite numbers"):
        evaluate_files(labels, results)


def test_errors_in_memory_say_what_to_do() -> None:
    labels = cars(1)
    with pytest.raises(BeamboxError, match="has no camera calibration"):
        evaluate([(labels, det(labels, [0.5]), None)])
    with pytest.raises(BeamboxError, match="has no image attributes"):
        evaluate([(labels, det(labels, [0.5]), CALIBRATION)])
    with pytest.raises(BeamboxError, match="no IoU threshold is known for class 'Tree'"):
        evaluate([(labels, det(labels, [0.5]), None)], ["Tree"], no_difficulty=True)
    with pytest.raises(BeamboxError, match=r"'cat', which is not scored \(did you mean \"car\"\?\)"):
        evaluate([(labels, det(labels, [0.5]), None)], min_overlap={"cat": 0.5}, no_difficulty=True)
    with pytest.raises(BeamboxError, match="no frame was given"):
        evaluate([])
