"""Augmentation: points move with their boxes, and the same draws give the same frame."""

from __future__ import annotations

import math

import numpy as np
import pydantic
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from beambox.checks import BeamboxError
from beambox.data.augment import (
    AugmentConfig,
    augment,
    flip_x,
    flip_y,
    move_objects,
    rotate,
    sample_objects,
    scale,
    shuffle_points,
    translate,
)
from beambox.data.bev_overlap import bev_overlap
from beambox.data.database import ObjectDatabase
from beambox.data.ground_plane import fit_ground_plane
from beambox.data.source import FrameList
from beambox.geometry import corners_bev
from beambox.ops.points_in_boxes import points_in_boxes_mask
from beambox.structures import Frame, Labels
from oracles.scenes import scene

BOX = st.tuples(
    st.floats(-8, 8),
    st.floats(-8, 8),
    st.floats(-2, 1),
    st.floats(0.3, 6),
    st.floats(0.3, 3),
    st.floats(0.5, 3),
    st.floats(-7, 7),
)


def database(frames: int = 12, name: str = "Car") -> ObjectDatabase:
    return ObjectDatabase.build(FrameList([scene(100 + k, name=name) for k in range(frames)]), [name])


def labels_of(frame: Frame) -> Labels:
    assert frame.labels is not None
    return frame.labels


def points_per_box(frame: Frame) -> list[int]:
    return points_in_boxes_mask(frame.points, labels_of(frame).boxes.double() * GROWN).sum(dim=1).tolist()


GROWN = torch.tensor([1, 1, 1, 1.001, 1.001, 1.001, 1])  # rounding to float32 must not push a point out


def same(a: Frame, b: Frame, atol: float = 1e-5) -> None:
    torch.testing.assert_close(a.points, b.points, atol=atol, rtol=1e-5)
    torch.testing.assert_close(labels_of(a).boxes[:, :6], labels_of(b).boxes[:, :6], atol=atol, rtol=1e-5)
    draw_index = labels_of(a).boxes[:, 6] - labels_of(b).boxes[:, 6]
    torch.testing.assert_close(torch.cos(draw_index), torch.ones_like(draw_index), atol=1e-5, rtol=0)


@given(st.lists(BOX, min_size=1, max_size=4), st.lists(BOX, min_size=1, max_size=4))
def test_overlap_agrees_with_polygons(first: list, second: list) -> None:
    a, b = np.array(first), np.array(second)
    found = bev_overlap(a[:, None], b)
    assert found.shape == (len(a), len(b))
    outlines = [[Polygon(quad) for quad in corners_bev(torch.from_numpy(boxes)).numpy()] for boxes in (a, b)]
    for i, p in enumerate(outlines[0]):
        for j, q in enumerate(outlines[1]):
            area = p.intersection(q).area
            if area > 1e-7 or p.distance(q) > 1e-7:  # bare contact may go either way
                assert found[i, j] == (area > 0), (first[i], second[j])


@settings(deadline=None)
@given(st.integers(0, 50), st.floats(-3, 3), st.floats(0.9, 1.1))
def test_steps_have_inverses(seed: int, angle: float, factor: float) -> None:
    frame = scene(seed)
    same(flip_x(flip_x(frame)), frame)
    same(flip_y(flip_y(frame)), frame)
    same(flip_x(flip_y(frame)), rotate(frame, math.pi))
    same(rotate(rotate(frame, angle), -angle), frame, atol=1e-4)
    same(scale(scale(frame, factor), 1 / factor), frame, atol=1e-4)


@pytest.mark.parametrize(
    "step",
    [
        flip_x,
        flip_y,
        lambda frame: rotate(frame, 0.7),
        lambda frame: scale(frame, 1.05),
        lambda frame: translate(frame, np.array([0.5, -2.0, 0.3])),
        lambda frame: move_objects(frame, np.random.default_rng(3), 0.7, (1.0, 1.0, 0.5)),
        lambda frame: shuffle_points(frame, np.random.default_rng(3)),
    ],
)
def test_points_stay_in_their_boxes_and_the_input_as_it_was(step) -> None:
    frame = scene(7, ground=0)
    before = frame.points.clone(), labels_of(frame).boxes.clone()
    moved = step(frame)
    assert points_per_box(moved) == [30] * 4
    assert float(labels_of(moved).boxes[:, 6].abs().max()) <= math.pi
    assert torch.equal(frame.points, before[0]) and torch.equal(labels_of(frame).boxes, before[1])
    assert not torch.equal(moved.points, frame.points)
    assert torch.equal(moved.points[:, 3].sort().values, frame.points[:, 3].sort().values)


@pytest.mark.parametrize("seed", range(5))
def test_moved_objects_do_not_collide_and_the_road_stays(seed: int) -> None:
    frame = scene(seed, objects=10)
    moved = move_objects(frame, np.random.default_rng(seed), math.pi / 2, (1.5, 1.5, 0))
    boxes = labels_of(moved).boxes.numpy()
    pairs = bev_overlap(boxes[:, None], boxes)
    np.fill_diagonal(pairs, False)
    assert not pairs.any()
    shift = labels_of(moved).boxes[:, :3] - labels_of(frame).boxes[:, :3]
    assert float(shift[:, :2].abs().mean()) > 0.5 and float(shift[:, 2].abs().max()) < 1e-6
    same_rows = (moved.points == frame.points).all(dim=1)
    assert bool(same_rows[300:].all()) and float(same_rows[:300].float().mean()) < 0.2


def test_an_object_hemmed_in_stays_where_it_is() -> None:
    wall = [[0, y, 0, 40, 1.999, 2, 0] for y in (-4, -2, 0, 2, 4)]
    frame = Frame(torch.zeros(1, 4), "", Labels(torch.tensor(wall), ("Car",) * 5))
    moved = move_objects(frame, np.random.default_rng(0), math.pi / 2, trials=30)
    turned = (labels_of(moved).boxes[:, 6] != 0).tolist()
    assert turned[1:4] == [False] * 3


def test_sampled_objects_stand_free_on_the_road_with_their_points() -> None:
    base = database()
    assert len(base) == 48
    for draw_index in range(6):
        frame = scene(draw_index)
        mixed = sample_objects(frame, AugmentConfig(sample={"Car": 12}), base, draw_index, seed=1)
        labels = labels_of(mixed)
        assert len(labels) > 4 and torch.equal(labels.boxes[:4], labels_of(frame).boxes)
        outlines = [Polygon(quad) for quad in corners_bev(labels.boxes.double()).numpy()]
        for i, p in enumerate(outlines):
            assert all(p.intersection(q).area < 1e-9 for q in outlines[:i])
        bottoms = labels.boxes[4:, 2] - labels.boxes[4:, 5] / 2
        torch.testing.assert_close(bottoms, torch.full_like(bottoms, -1.7), atol=0.02, rtol=0)
        added = 30 * (len(labels) - 4)
        own = points_in_boxes_mask(mixed.points[:added], labels.boxes[4:] * GROWN)
        assert all(bool(own[k, 30 * k : 30 * k + 30].all()) for k in range(len(own)))
        assert not bool(points_in_boxes_mask(mixed.points[added:], labels.boxes[4:]).any())
        assert not torch.equal(mixed.points[:added], frame.points[:added])
        assert len(mixed) <= len(frame) + added


def test_scene_points_inside_a_sampled_box_are_removed() -> None:
    base = database(1)
    at = torch.from_numpy(base.boxes[:1, :3])
    scene_points = torch.cat((at + torch.tensor([[0.3, 0, 0]]), at + torch.tensor([[9.0, 9, 0]])))
    frame = Frame(torch.cat((scene_points, torch.zeros(2, 1)), dim=1), "", Labels.empty())
    mixed = sample_objects(frame, AugmentConfig(sample={"Car": 4}, sample_on_road=False), base, 0, 0)
    assert len(mixed) == 4 * 30 + 1
    assert torch.equal(mixed.points[-1], frame.points[1])


def test_whole_scene_counts_what_is_there() -> None:
    frame, base = scene(3, objects=6), database()
    config = AugmentConfig(sample={"Car": 6}, sample_whole_scene=True)
    assert len(labels_of(sample_objects(frame, config, base, 0, 0))) == 6
    assert len(labels_of(sample_objects(frame, AugmentConfig(sample={"Car": 6}), base, 0, 0))) > 6


def test_sampled_objects_keep_clear_of_every_labeled_class() -> None:
    base = database(1)
    blocked = Frame(torch.zeros(1, 4), "", Labels(torch.from_numpy(base.boxes), ("Van",) * 4))
    assert sample_objects(blocked, AugmentConfig(sample={"Car": 4}), base, 0, 0) is blocked


def test_augmentation_is_a_function_of_its_arguments() -> None:
    frame, base = scene(3), database()
    config = AugmentConfig(sample={"Car": 5}, object_rotation=0.5, object_translation=(0.5, 0.5, 0.1), flip_y=0.5)
    runs = [augment(frame, np.random.default_rng((4, k)), config, base, draw_index=2, seed=9) for k in (0, 0, 1)]
    assert torch.equal(runs[0].points, runs[1].points)
    assert torch.equal(labels_of(runs[0]).boxes, labels_of(runs[1]).boxes)
    assert not torch.equal(labels_of(runs[0]).boxes, labels_of(runs[2]).boxes)
    assert runs[0].calibration is None and runs[0].image_size is None


def test_nothing_switched_on_changes_nothing() -> None:
    frame = scene(3)
    off = AugmentConfig(sample={}, flip_x=0, rotation=0, scaling=(1, 1), shuffle=False)
    same(augment(frame, np.random.default_rng(0), off), frame, atol=1e-7)


def test_one_step_does_not_change_the_numbers_of_another() -> None:
    frame = scene(3)
    plain = AugmentConfig(sample={}, shuffle=False)
    noisy = AugmentConfig(sample={}, shuffle=False, object_rotation=0.2)
    shifted = AugmentConfig(sample={}, shuffle=False, translation=(0.0, 0.0, 0.3))
    road = [augment(frame, np.random.default_rng(5), config).points[200:] for config in (plain, noisy)]
    torch.testing.assert_close(road[0], road[1])
    moved = augment(frame, np.random.default_rng(5), shifted).points[200:] - road[0]
    torch.testing.assert_close(moved[:, :2], torch.zeros_like(moved[:, :2]))
    assert float(moved[:, 2].std()) < 1e-5 < abs(float(moved[:, 2].mean()))


def test_bad_settings_and_frames_are_refused() -> None:
    with pytest.raises(pydantic.ValidationError, match="flip_z"):
        AugmentConfig(flip_z=0.5)  # type: ignore[call-arg]
    with pytest.raises(pydantic.ValidationError, match="less than or equal to 1"):
        AugmentConfig(flip_x=2)
    bare = Frame(torch.zeros(1, 4), "000012")
    with pytest.raises(BeamboxError, match="only labelled frames can be augmented, but 000012 has no labels"):
        augment(bare, np.random.default_rng(0), AugmentConfig())


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-3, 1), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_the_road_is_found_under_cars_and_strays(slope_x: float, slope_y: float, height: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-35, 35, (8000, 2))
    z = xy @ [slope_x, slope_y] + height + rng.normal(0, 0.02, 8000)
    tall = (xy[:, 0] > 10) & (np.abs(xy[:, 1]) < 8)  # walls that hide a fifth of the road
    z[tall] += rng.uniform(0.5, 6, tall.sum())
    z[:20] -= rng.uniform(1, 4, 20)  # reflections below the road
    points = torch.from_numpy(np.concatenate((xy, z[:, None]), axis=1).astype(np.float32))
    plane = fit_ground_plane(points)
    assert plane is not None
    a, b, c, d = plane.tolist()
    assert math.isclose(a * a + b * b + c * c, 1, abs_tol=1e-5) and c > 0
    for x, y in ((0, 0), (20, 10), (20, -10), (-20, 10)):
        assert -(a * x + b * y + d) / c == pytest.approx(slope_x * x + slope_y * y + height, abs=0.25)


def test_too_few_points_make_no_road() -> None:
    assert fit_ground_plane(torch.zeros(0, 4)) is None
    assert fit_ground_plane(torch.rand(5, 4)) is None
