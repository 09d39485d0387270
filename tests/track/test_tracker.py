"""The tracker on scenes whose truth is known, and on KITTI's drive 0012."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.structures import Detections
from beambox.track import Tracker, TrackerOptions
from beambox.track.poses import carry_boxes

pytest.importorskip("filterpy")

CLASSES = ("Car", "Pedestrian")


def found(boxes: list[list[float]], scores: list[float] | None = None, names: list[str] | None = None) -> Detections:
    ids = [CLASSES.index(name) for name in names or ["Car"] * len(boxes)]
    return Detections(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 7),
        torch.tensor(scores or [0.9] * len(boxes)),
        torch.tensor(ids, dtype=torch.int64),
        CLASSES,
    )


def car(x: float, y: float, yaw: float = 0.0) -> list[float]:
    return [x, y, -1.0, 4.0, 1.7, 1.5, yaw]


def test_identities_and_velocities_of_crossing_cars() -> None:
    """Two cars pass each other at 3 m; noise of 0.1 m. Identities never change, velocities come within 1 m/s."""
    rng, tracker = np.random.default_rng(0), Tracker(rate=10)
    for k in range(40):
        t = k / 10
        boxes = [car(10 + 12 * t, 1.5), car(60 - 12 * t, -1.5, math.pi)]
        for box in boxes:
            box[:2] = (np.array(box[:2]) + rng.normal(0, 0.1, 2)).tolist()
        order = rng.permutation(2)
        tracks = tracker.update(found([boxes[i] for i in order]))
        assert sorted(tracks.ids.tolist()) == [1, 2]
        ahead = int(tracks.detections.boxes[:, 0].argmin()) if k < 15 else None
        if k == 0:
            first = int(tracks.ids[ahead])
    mine = tracks.ids.tolist().index(first)
    assert tracks.velocities[mine, :2].tolist() == pytest.approx([12, 0], abs=1.0)
    assert tracks.velocities[1 - mine, :2].tolist() == pytest.approx([-12, 0], abs=1.0)
    assert tracks.ages.tolist() == pytest.approx([3.9, 3.9], abs=1e-5)


def test_poses_make_parked_cars_stand_still_while_the_sensor_turns_and_drives() -> None:
    parked = np.array([car(20, 5, 0.3), car(30, -6, 1.2)])
    tracker = Tracker()
    for k in range(20):
        angle, pose = 0.06 * k, np.eye(4)
        pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        pose[:3, 3] = [1.0 * k, 0.2 * k, 0.0]
        seen = carry_boxes(parked, np.linalg.inv(pose))
        tracks = tracker.update(found(seen.tolist()), pose=pose)
        assert tracks.ids.tolist() == [1, 2]
        torch.testing.assert_close(tracks.detections.boxes[:, :6], torch.tensor(seen[:, :6]).float(), atol=1e-3, rtol=0)
    assert float(tracks.speeds.max()) < 1e-3


def test_velocities_are_given_along_the_axes_of_the_sensor() -> None:
    """The sensor looks along the world's y; a car that moves along the world's x moves to the sensor's right."""
    pose = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    tracker = Tracker()
    for k in range(30):
        seen = carry_boxes(np.array([car(1.0 * k, 20)]), np.linalg.inv(pose))
        tracks = tracker.update(found(seen.tolist()), pose=pose)
    assert tracks.velocities[0].tolist() == pytest.approx([0, -10, 0], abs=0.2)


def test_the_rate_does_not_change_what_is_confirmed_and_when_tracks_end() -> None:
    """A car of score 0.9 is reported at once and forgotten after 0.5 s * ln 9 = 1.1 s, whatever the rate."""
    for rate in (2, 10, 50):
        tracker = Tracker(rate=rate, options=TrackerOptions(coast=100))
        for _ in range(2 * rate):
            assert len(tracker.update(found([car(10, 0)]))) == 1
        lost = 0
        while len(tracker.update(found([]))):
            lost += 1
        assert lost / rate == pytest.approx(0.5 * math.log(0.9 / 0.1), abs=1 / rate)


def test_births_and_deaths_by_score() -> None:
    tracker = Tracker()
    assert len(tracker.update(found([car(10, 0)], [0.29]))) == 0
    assert len(tracker.update(found([car(10, 0)], [0.4]))) == 0  # born, not sure yet
    shown = [len(tracker.update(found([car(10, 0)], [0.8]))) for _ in range(5)]
    assert shown == sorted(shown) and shown[-1] == 1
    tracks = tracker.update(found([car(10, 0)], [0.15]))  # too weak to start a track, continues one
    assert tracks.ids.tolist() == [1] and tracks.missed.tolist() == [0]
    assert len(tracker.update(found([car(10, 0)], [0.05]))) == 0  # left out: missed


def test_a_false_positive_that_stays_is_not_multiplied_up_to_a_track() -> None:
    tracker = Tracker()
    assert not any(len(tracker.update(found([car(10, 0)], [0.4]))) for _ in range(200))


def test_coasting_predicts_with_the_last_velocity() -> None:
    tracker = Tracker(TrackerOptions(coast=0.5))
    for k in range(20):
        tracker.update(found([car(1.0 * k, 0)]))
    tracks = [tracker.update(found([])) for _ in range(6)]
    assert [len(one) for one in tracks] == [1, 1, 1, 1, 1, 0]
    assert float(tracks[3].detections.boxes[0, 0]) == pytest.approx(23, abs=0.3)
    assert float(tracks[3].missed[0]) == pytest.approx(0.4, abs=1e-6)


def test_a_heading_turned_round_now_and_then_is_mended_and_one_found_wrong_first_as_well() -> None:
    tracker = Tracker()
    for k in range(20):
        tracks = tracker.update(found([car(10 + k, 0, math.pi if k % 4 == 3 else 0.0)]))
    assert abs(float(tracks.detections.boxes[0, 6])) < 0.1
    tracker = Tracker()
    for k in range(20):
        tracks = tracker.update(found([car(10 + k, 0, math.pi if k < 2 else 0.0)]))
    assert abs(float(tracks.detections.boxes[0, 6])) < 0.1


def test_classes_do_not_mix_and_identities_are_never_given_twice() -> None:
    tracker = Tracker()
    a = tracker.update(found([car(10, 0), car(10, 0.2)], names=["Car", "Pedestrian"]))
    assert dict(zip(a.names, a.ids.tolist())) == {"Car": 1, "Pedestrian": 2}
    tracker.reset()
    assert tracker.update(found([car(10, 0)])).ids.tolist() == [3]


def test_matching_is_the_best_for_all_and_not_greedy() -> None:
    """Two cars both jump 1.5 m to the right; nearest first would give the left one's new place to the right one."""
    tracker = Tracker(TrackerOptions(speeds={"Car": 30.0}))
    tracker.update(found([car(10, 0), car(10, -2.0)]))
    tracks = tracker.update(found([car(10, -1.5), car(10, -3.5)]))
    assert tracks.ids.tolist() == [1, 2]
    assert tracks.detections.boxes[:, 1].tolist() == pytest.approx([-1.5, -3.5], abs=0.2)


def test_what_cannot_be_tracked_is_refused() -> None:
    tracker = Tracker()
    tracker.update(found([car(10, 0)]), time=5.0)
    with pytest.raises(BeamboxError, match="in order of time, got 4 s after 5 s"):
        tracker.update(found([]), time=4.0)
    with pytest.raises(BeamboxError, match="must be finite"):
        tracker.update(found([[math.nan, 0, 0, 1, 1, 1, 0]]))
    with pytest.raises(BeamboxError, match="rotation and a translation"):
        tracker.update(found([]), pose=np.diag([2.0, 2, 2, 1]))
    with pytest.raises(BeamboxError, match="`rate` must be a positive number"):
        Tracker(rate=0)
    with pytest.raises(BeamboxError, match="`birth_score`"):
        TrackerOptions(score_threshold=0.5, birth_score=0.3)


def test_without_the_library_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    with pytest.raises(
        BeamboxError, match=r'needs the library filterpy, which is not installed: python -m pip install "\.\[track\]"'
    ):
        Tracker()


def test_slices_and_rows() -> None:
    tracks = Tracker().update(found([car(10, 0), car(20, 0)]), time=2.0)
    assert len(tracks[tracks.ids == 2]) == 1
    row = tracks[:1].to_rows()[0]
    assert (row["id"], row["name"], row["time"], row["vx"], row["x"]) == (1, "Car", 2.0, 0.0, 10.0)
