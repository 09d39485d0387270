"""The object database: what is cut out, the walk through it, its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.database import ObjectDatabase
from beambox.data.kitti import KittiSource
from beambox.data.sampling import shuffled_indices
from beambox.data.source import FrameList
from beambox.structures import ImageAttributes, Labels
from oracles.paths import data_dir
from oracles.scenes import scene


@given(st.integers(1, 30), st.integers(0, 100), st.integers(0, 60), st.integers(0, 5))
def test_a_walk_visits_everything_once_a_pass(size: int, start: int, count: int, seed: int) -> None:
    whole = shuffled_indices(size, 0, 8 * size, (seed,))
    for draw_index in range(8):
        assert sorted(whole[draw_index * size : (draw_index + 1) * size]) == list(range(size))
    assert shuffled_indices(size, start, count, (seed,)).tolist() == [
        int(shuffled_indices(size, k, 1, (seed,))[0]) for k in range(start, start + count)
    ]


def test_objects_are_cut_with_their_points() -> None:
    frames = [scene(k) for k in range(3)]
    base = ObjectDatabase.build(FrameList(frames), ["Pedestrian", "Car"])
    assert base.counts() == {"Pedestrian": 0, "Car": 12} and base.frames[4] == "000001"
    labels = frames[1].labels
    assert labels is not None
    np.testing.assert_array_equal(base.boxes[4:8], labels.boxes.numpy())
    actual = base.points_of(np.array([4, 6]), base.boxes[[4, 6], :3])
    expected = torch.cat((frames[1].points[:30], frames[1].points[60:90])).numpy()
    np.testing.assert_allclose(actual, expected, atol=1e-5)
    assert base.points_of(np.zeros(0, dtype=np.int64), np.zeros((0, 3))).shape == (0, 4)


def test_small_and_unknown_objects_are_left_out() -> None:
    frame = scene(0, per_object=6)
    labels = frame.labels
    assert labels is not None
    image = torch.tensor([[0, 0, 50, 60.0], [0, 0, 50, 60], [0, 0, 50, 10], [0, 0, 50, 60]])
    attributes = ImageAttributes(torch.zeros(4), torch.tensor([0, 3, 0, 2]), torch.zeros(4), image)
    marked = replace(frame, labels=replace(labels, attributes=attributes))
    assert len(ObjectDatabase.build(FrameList([marked]), ["Car"])) == 2
    assert len(ObjectDatabase.build(FrameList([marked]), ["Car"], drop_unknown_difficulty=False)) == 4
    assert len(ObjectDatabase.build(FrameList([marked]), ["Car"], min_points=7)) == 0
    with pytest.raises(BeamboxError, match="needs labelled frames, but 000000 has no labels"):
        ObjectDatabase.build(FrameList([replace(frame, labels=None)]), ["Car"])


def test_draws_walk_through_all_objects() -> None:
    base = ObjectDatabase.build(FrameList([scene(k) for k in range(5)]), ["Car"])
    drawn = np.concatenate([base.draw("Car", 5, draw_index, seed=3) for draw_index in range(4)])
    assert sorted(drawn.tolist()) == list(range(20))
    assert base.draw("Car", 5, 2, 3).tolist() == base.draw("Car", 5, 2, 3).tolist()
    assert base.draw("Car", 5, 2, 3).tolist() != base.draw("Car", 5, 2, 4).tolist()
    assert len(base.draw("Car", 50, 1, 0)) == 20
    with pytest.raises(BeamboxError, match=r'no class "Cars" \(did you mean "Car"\?\)'):
        base.draw("Cars", 1, 0, 0)


def test_whatever_is_present_no_object_comes_twice_in_a_pass() -> None:
    boxes = np.zeros((24, 7), np.float32)
    boxes[:, 0], boxes[:, 3:6] = np.arange(24) * 10, 1  # far apart
    base = ObjectDatabase(
        boxes, np.zeros((24, 4), np.float32), np.arange(25), np.zeros(24, np.int64), ("Car",), ("",) * 24
    )
    nothing, cars = np.zeros((0, 7), np.float32), [("Car", 6)]
    drawn = [
        base.sample(nothing, cars, draw_index, 0, {"Car": here})[0] for draw_index, here in enumerate((0, 3, 4, 9))
    ]
    assert [len(some) for some in drawn] == [6, 3, 2, 0]
    assert len(set(np.concatenate(drawn).tolist())) == 11
    assert base.sample(nothing, cars, 1, 0, {"Van": 5})[0].tolist() == base.sample(nothing, cars, 1, 0)[0].tolist()


def test_of_two_colliding_candidates_both_go() -> None:
    boxes = np.array([[5, 0, 0, 4, 2, 1.5, 0], [6, 1, 0, 4, 2, 1.5, 0], [20, 0, 0, 4, 2, 1.5, 0]], dtype=np.float32)
    base = ObjectDatabase(
        boxes, np.zeros((3, 4), np.float32), np.arange(4), np.zeros(3, np.int64), ("Car",), ("a", "b", "c")
    )
    objects, names = base.sample(np.zeros((0, 7), np.float32), [("Car", 3)], 0, 0)
    assert objects.tolist() == [2] and names == ["Car"]
    assert base.sample(boxes[2:], [("Car", 3)], 0, 0)[0].tolist() == []


def test_classes_are_drawn_in_turn_and_keep_clear_of_each_other() -> None:
    boxes = np.array([[5, 0, 0, 4, 2, 1.5, 0], [6, 1, 0, 1, 1, 1.5, 0]], dtype=np.float32)
    base = ObjectDatabase(
        boxes, np.zeros((2, 4), np.float32), np.arange(3), np.arange(2), ("Car", "Pedestrian"), ("a", "b")
    )
    nothing = np.zeros((0, 7), np.float32)
    assert base.sample(nothing, [("Car", 1), ("Pedestrian", 1)], 0, 0)[1] == ["Car"]
    assert base.sample(nothing, [("Pedestrian", 1), ("Car", 1)], 0, 0)[1] == ["Pedestrian"]


def test_the_file_comes_back_and_joins(tmp_path: Path) -> None:
    cars = ObjectDatabase.build(FrameList([scene(0), scene(1)]), ["Car"])
    people = ObjectDatabase.build(FrameList([scene(2, name="Pedestrian")]), ["Pedestrian", "Car"])
    cars.save(tmp_path / "cars.npz")
    again = ObjectDatabase.load(tmp_path / "cars.npz")
    for name in ("boxes", "points", "offsets", "labels"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cars, name))
    assert again.classes == cars.classes and again.frames == cars.frames
    both = ObjectDatabase.joined([again, people])
    assert both.counts() == {"Car": 8, "Pedestrian": 4} and len(both) == 12
    np.testing.assert_array_equal(both.points_of(np.array([9]), np.zeros((1, 3))), people.points[30:60])


def test_other_files_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", boxes=np.zeros(3))
    with pytest.raises(BeamboxError, match="is not an object database of this version; build it again"):
        ObjectDatabase.load(tmp_path / "other.npz")
    (tmp_path / "noise.npz").write_bytes(b"PK\x03\x04 and so on")
    with pytest.raises(BeamboxError, match="is not a readable object database, or is damaged"):
        ObjectDatabase.load(tmp_path / "noise.npz")
    with pytest.raises(MissingFileError, match="is not there"):
        ObjectDatabase.load(tmp_path / "none.npz")


def test_real_frames_make_a_database() -> None:
    source = KittiSource(data_dir("kitti"), "full")
    base = ObjectDatabase.build(source, ["Car", "Pedestrian", "Cyclist"])
    assert base.counts()["Car"] >= 5 and int(np.diff(base.offsets).min()) >= 5
    lengths = np.repeat(np.linalg.norm(base.boxes[:, 3:6], axis=1) / 2, np.diff(base.offsets))
    assert (np.linalg.norm(base.points[:, :3], axis=1) <= lengths + 1e-4).all()


def test_an_empty_database_samples_nothing(tmp_path: Path) -> None:
    frame = scene(0)
    base = ObjectDatabase.build(FrameList([replace(frame, labels=Labels.empty())]), ["Car"])
    base.save(tmp_path / "none.npz")
    assert base.sample(np.zeros((0, 7)), [("Car", 3)], 0, 0)[0].tolist() == []
    assert len(ObjectDatabase.load(tmp_path / "none.npz")) == 0
