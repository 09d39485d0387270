"""Errors of matched boxes: against known displacements, pairs by shapely, and nuScenes' errors by plain loops."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from shapely import affinity
from shapely.geometry import box as rectangle

from beambox.checks import BeamboxError
from beambox.geometry.boxes import local_to_world
from beambox.metrics.box_errors import box_errors
from beambox.metrics.box_errors_result import COLUMNS
from beambox.metrics.kitti import KittiFrame
from beambox.structures import Detections, ImageAttributes, Labels
from oracles import nuscenes_tp

CLASSES = ("Car", "Pedestrian")


def frame(gt: torch.Tensor, det: torch.Tensor, scores: torch.Tensor | None = None, **labels) -> KittiFrame:
    scores = torch.linspace(0.9, 0.5, len(det)) if scores is None else scores
    return KittiFrame(
        Labels(gt, ("Car",) * len(gt), **labels),
        Detections(det, scores, torch.zeros(len(det), dtype=torch.int64), CLASSES),
    )


def spread_out(count: int, seed: int) -> torch.Tensor:
    """Cars on a lattice, so that none is near another, of any heading, at 5 to 70 m."""
    rng = np.random.default_rng(seed)
    places = rng.permutation(48)[:count]
    x, y = 5.0 + 8 * (places % 8) + rng.uniform(-1, 1, count), -20.0 + 8 * (places // 8) + rng.uniform(-1, 1, count)
    sizes = rng.uniform((3.5, 1.5, 1.4), (4.5, 1.9, 1.7), (count, 3))
    return torch.tensor(np.column_stack((x, y, rng.uniform(-1.5, 0, count), sizes, rng.uniform(-3, 3, count)))).float()


def test_a_constant_displacement_is_told_in_every_frame_of_reference() -> None:
    gt = spread_out(30, 1)
    along = gt.clone()
    along[:, :3] = local_to_world(torch.tensor([0.3, -0.1, 0.2]).expand(30, 1, 3), gt)[:, 0]
    along[:, 3:6] += torch.tensor([-0.05, 0.04, 0.1])
    along[:, 6] += 0.1
    overall = box_errors([frame(gt, along)], ["Car"])["Car"]["overall"]
    assert (overall.matched, overall.objects) == (30, 30)
    for name, value in {"along": 0.3, "across": -0.1, "z": 0.2, "length": -0.05, "width": 0.04, "height": 0.1}.items():
        assert overall.mean[name] == pytest.approx(value, abs=1e-5), name
        assert overall.spread[name] == pytest.approx(0, abs=1e-5), name
    assert overall.mean["heading"] == pytest.approx(0.1, abs=1e-5)
    assert overall.spread["x"] > 0.1
    away = gt.clone()
    away[:, :2] *= 1 + 0.2 / gt[:, :2].norm(dim=1, keepdim=True)  # 0.2 m farther along each ray
    away[:, 0] += 0.0
    result = box_errors([frame(gt, away)], ["Car"])["Car"]["overall"]
    assert result.mean["range"] == pytest.approx(0.2, abs=1e-5)
    assert result.spread["range"] == pytest.approx(0, abs=1e-5)
    shifted = gt + torch.tensor([0.15, -0.2, 0.04, 0, 0, 0, 0])
    result = box_errors([frame(gt, shifted)], ["Car"])["Car"]["overall"]
    assert [result.mean[k] for k in ("x", "y", "z")] == pytest.approx([0.15, -0.2, 0.04], abs=1e-5)


def test_mean_and_spread_by_distance_equal_numpy() -> None:
    gt, rng = spread_out(40, 2), torch.Generator().manual_seed(0)
    det = gt + 0.05 * torch.randn(40, 7, generator=rng)
    det[:, 6] += math.pi * (torch.arange(40) % 4 == 0)  # a quarter points the other way
    errors = box_errors([frame(gt[:25], det[:25]), frame(gt[25:], det[25:])], ["Car"])["Car"]
    difference = (det - gt).double().numpy()
    difference[:, 6] = np.arctan(np.tan(difference[:, 6]))
    distance = gt[:, :2].norm(dim=1).numpy()
    inside = {"overall": distance >= 0, "0-20m": distance < 20, "40m-inf": distance >= 40}
    inside["20-40m"] = ~inside["0-20m"] & ~inside["40m-inf"]
    assert sum(errors[name].matched for name in inside) == 80
    for band, mask in inside.items():
        assert errors[band].matched == mask.sum() > 3
        for column, name in ((0, "x"), (1, "y"), (2, "z"), (3, "length"), (4, "width"), (5, "height"), (6, "heading")):
            assert errors[band].mean[name] == pytest.approx(difference[mask, column].mean(), abs=1e-5)
            assert errors[band].spread[name] == pytest.approx(difference[mask, column].std(), abs=1e-5)
    assert errors.flipped == pytest.approx(25)


def area(box: torch.Tensor):
    x, y, _, length, width, _, yaw = box.tolist()
    return affinity.translate(
        affinity.rotate(rectangle(-length / 2, -width / 2, length / 2, width / 2), yaw, use_radians=True), x, y
    )


def test_pairs_are_those_of_a_plain_search_with_polygons() -> None:
    """Crowded boxes, many of which overlap several: the pairs, told by their z, are those of a loop over polygons."""
    rng = np.random.default_rng(4)
    frames, expected = [], []
    for _ in range(6):
        gt = torch.tensor(
            np.column_stack(
                (rng.uniform((0, 0, -1), (12, 12, 0), (14, 3)), np.tile((4, 1.8, 1.5), (14, 1)), rng.uniform(-3, 3, 14))
            )
        ).float()
        det = torch.cat((gt, gt)) + torch.tensor(rng.normal(0, 0.5, (28, 7)) * (1, 1, 1, 0, 0, 0, 1)).float()
        scores = torch.tensor(rng.permutation(28) / 28).float()
        frames.append(frame(gt, det, scores))
        free = set(range(14))
        for j in scores.argsort(descending=True).tolist():
            overlaps = {}
            for i in free:
                shared = area(gt[i]).intersection(area(det[j])).area
                overlaps[i] = shared / (2 * 4 * 1.8 - shared)
            best = max(overlaps, key=lambda i: overlaps[i], default=None)
            if best is not None and overlaps[best] > 0.25:
                free.remove(best)
                expected.append(float(det[j, 2] - gt[best, 2]))
    overall = box_errors(frames, ["Car"])["Car"]["overall"]
    assert overall.matched == len(expected)
    assert overall.mean["z"] == pytest.approx(np.mean(expected), abs=1e-6)
    assert overall.spread["z"] == pytest.approx(np.std(expected), abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_nuscenes_errors_equal_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames, truths, founds = [], [], []
    scores = iter(torch.tensor(rng.permutation(400) / 400).double().tolist())
    for number in range(5):
        gt = spread_out(int(rng.integers(0, 9)), 10 * seed + number)
        keep = rng.random(len(gt)) < 0.7
        near = (
            gt[torch.tensor(keep)]
            + torch.tensor(rng.normal(0, (0.4, 0.4, 0.1, 0.2, 0.1, 0.1, 0.8), (keep.sum(), 7))).float()
        )
        det = torch.cat((near, near + 0.1, spread_out(int(rng.integers(0, 6)), 1000 + 10 * seed + number)))
        own = torch.tensor([next(scores) for _ in det]).float()
        frames.append(frame(gt, det, own))
        truths.append([tuple(row) for row in gt.double().tolist()])
        founds.append(list(zip(own.double().tolist(), [tuple(row) for row in det.double().tolist()])))
    errors = box_errors(frames, ["Car"])["Car"]
    assert (errors.ate, errors.ase, errors.aoe) == pytest.approx(nuscenes_tp.errors(truths, founds), abs=1e-9)
    assert 0 < errors.ate < 1


def test_nothing_found_nothing_there_and_other_classes() -> None:
    gt = spread_out(12, 3)
    errors = box_errors([frame(gt, gt[:0])], ["car", "Pedestrian"])
    car, pedestrian = errors["car"], errors["Pedestrian"]
    assert (car["overall"].objects, car["overall"].matched, car.ate, car.aoe) == (12, 0, 1.0, 1.0)
    assert math.isnan(car["overall"].mean["x"])
    assert pedestrian["overall"].objects == 0
    assert math.isnan(pedestrian.ate)
    one = box_errors([frame(gt, gt[:1])], ["Car"])["Car"]
    assert (one["overall"].matched, one.ate) == (1, 1.0), "a recall of 1/12 is below nuScenes' least"
    content = json.loads(json.dumps(errors.to_json(), allow_nan=False))
    assert content["car"]["overall"]["x"] == {"mean": None, "spread": None}
    assert set(content["car"]["0-20m"]) == {"objects", "matched", *COLUMNS}
    with pytest.raises(BeamboxError, match="no frame was given"):
        box_errors([], ["Car"])


def test_objects_beyond_hard_take_their_detection_and_count_for_nothing() -> None:
    gt = spread_out(3, 5)
    image = torch.tensor([[0.0, 0, 100, 100], [0, 0, 100, 100], [0, 0, 0, 0]])
    attributes = ImageAttributes(
        torch.tensor([0.0, 0.9, 0.0]), torch.zeros(3, dtype=torch.int64), torch.zeros(3), image
    )
    det = gt + torch.tensor([[0.0] * 7, [0.5, 0, 0, 0, 0, 0, 0], [0.0] * 7])
    errors = box_errors([frame(gt, det, attributes=attributes)], ["Car"])["Car"]
    assert (errors["overall"].objects, errors["overall"].matched) == (2, 2), (
        "truncated by 0.9; labelled without a camera"
    )
    assert errors["overall"].mean["x"] == pytest.approx(0, abs=1e-6)
    assert errors.ate == pytest.approx(0, abs=1e-6)


def test_table_names_units_and_numbers() -> None:
    gt = spread_out(12, 3)
    table = box_errors([frame(gt, gt + torch.tensor([0.12, 0, 0, 0, 0, 0, 0.1]))], ["Car", "Pedestrian"]).table()
    assert "Car: ATE 0.120 m, ASE 0.000, AOE 0.100 rad (nuScenes, 2 m); 0.0 % point the other way" in table
    row = next(line for line in table.splitlines() if line.startswith("overall"))
    assert row.split()[:4] == ["overall", "12/12", "+12.0", "+-"]
    assert row.endswith("+5.7 +- 0.0")
    assert "Pedestrian: ATE - m" in table
