"""Streams: a recording in, boxes out with its stamps, topics and frame ids; read again by the libraries of Foxglove."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.stream.run import in_real_time, recording_writer, run_stream
from beambox.stream.source import Arrival, arrivals
from beambox.structures import Detections, Frame
from oracles.recordings import record

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
pytest.importorskip("foxglove")
pytest.importorskip("filterpy")

from beambox.track import Tracker

START = 1_700_000_000_000_000_000


def clouds(count: int) -> list[np.ndarray]:
    """One point each, 1 m farther every sweep: the detector below puts a box around it."""
    return [np.array([[10.0 + k, 2.0, -1.0, 0.5]], np.float32) for k in range(count)]


def detect(frame: Frame) -> Detections:
    x, y, z = frame.points[0, :3].tolist()
    boxes = torch.tensor([[x, y, z, 4.0, 1.7, 1.5, 0.5]])
    return Detections(boxes, torch.tensor([0.9]), torch.zeros(1, dtype=torch.int64), ("Car",), frame.id)


def written(path: Path) -> dict[str, list]:
    """Read a recording by mcap's own reader: topic -> (schema, message)."""
    from mcap.reader import make_reader

    found: dict[str, list] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append((schema, message))
    return found


@pytest.mark.parametrize("kind", ["drive.mcap", "drive.db3", "drive.bag"])
def test_boxes_come_back_under_the_sweeps_stamps_and_frames(kind: str, tmp_path: Path) -> None:
    source = record(tmp_path / kind, clouds(8))
    out = tmp_path / "boxes.mcap"
    with recording_writer(out, {"model": "none"}) as write:
        report = run_stream(arrivals(source), detect, Tracker(), write)
        assert not out.exists()  # appears once it is whole
    assert (report.done, report.dropped, report.unreadable) == (8, 0, [])
    found = written(out)
    assert set(found) == {f"/lidar/top/beambox/{name}" for name in ("markers", "detections", "scene")}
    for messages in found.values():
        assert [m.log_time for _, m in messages] == [START + 100_000_000 * k + 7 for k in range(8)]
        assert [m.publish_time for _, m in messages] == [START + 100_000_000 * k for k in range(8)]


def test_ros_messages_are_read_by_mcaps_decoder(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader")
    source, out = record(tmp_path / "drive.mcap", clouds(6)), tmp_path / "boxes.mcap"
    with recording_writer(out, {}) as write:
        run_stream(arrivals(source), detect, Tracker(), write)
    topics = ["/lidar/top/beambox/detections", "/lidar/top/beambox/markers"]
    messages = list(reader.read_ros2_messages(str(out), topics=topics))
    last = [m.ros_msg for m in messages if m.channel.topic == topics[0]][-1]
    (found,) = last.detections
    assert (last.header.frame_id, found.header.stamp.sec, found.header.stamp.nanosec) == (
        "lidar",
        START // 10**9,
        500_000_000,
    )
    assert (found.id, found.results[0].hypothesis.class_id) == ("1", "Car")
    assert found.bbox.center.position.x == pytest.approx(15, abs=0.1)
    assert (found.bbox.size.x, found.bbox.size.y, found.bbox.size.z) == pytest.approx((4, 1.7, 1.5), abs=1e-5)
    assert found.bbox.center.orientation.z == pytest.approx(np.sin(0.25), abs=1e-5)
    clear, cube = [m.ros_msg for m in messages if m.channel.topic == topics[1]][-1].markers
    assert (clear.action, cube.type, cube.id, cube.ns) == (3, 1, 1, "Car")


def test_scene_updates_are_read_by_foxgloves_protobuf(tmp_path: Path) -> None:
    scenes = pytest.importorskip("foxglove_schemas_protobuf.SceneUpdate_pb2")
    source, out = record(tmp_path / "drive.mcap", clouds(3)), tmp_path / "boxes.mcap"
    with recording_writer(out, {}) as write:
        run_stream(arrivals(source), detect, Tracker(), write)
    schema, message = written(out)["/lidar/top/beambox/scene"][-1]
    scene = scenes.SceneUpdate.FromString(message.data)
    assert (schema.name, schema.encoding) == ("foxglove.SceneUpdate", "protobuf")
    (entity,) = scene.entities
    assert (entity.frame_id, len(entity.cubes), len(scene.deletions)) == ("lidar", 1, 1)
    assert entity.cubes[0].size.x == pytest.approx(4.0) and "Car 1" in entity.texts[0].text


def test_a_recording_is_opened_and_gone_through_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbags.highlevel import AnyReader

    source, opened, passes = record(tmp_path / "drive.mcap", clouds(5)), [], []
    opens, reads = AnyReader.open, AnyReader.messages
    monkeypatch.setattr(AnyReader, "open", lambda self: (opened.append(1), opens(self))[1])
    monkeypatch.setattr(AnyReader, "messages", lambda self, *a, **k: (passes.append(1), reads(self, *a, **k))[1])
    assert len([one.read() for one in arrivals(source)]) == 5
    assert (len(opened), len(passes)) == (1, 1)


def test_several_topics_need_a_name_and_packets_say_what_to_do(tmp_path: Path) -> None:
    source = record(tmp_path / "two.mcap", clouds(2), ("/front/points", "/rear/points"))
    with pytest.raises(BeamboxError, match="under front/points, rear/points; name one by --topic"):
        next(arrivals(source))
    assert {one.topic for one in arrivals(source, "/rear/points")} == {"/rear/points"}
    with pytest.raises(BeamboxError, match=r'no point clouds under "rear/point" \(did you mean "rear/points"\?\)'):
        next(arrivals(source, "rear/point"))


def test_a_damaged_sweep_is_left_out_and_a_jump_in_time_begins_anew(tmp_path: Path) -> None:
    def broken() -> Frame:
        raise BeamboxError("sweep 2 is damaged")

    def arrival(k: int, seconds: float) -> Arrival:
        stamp, points = round(seconds * 1e9), torch.tensor([[10.0, 2, -1, 0]])
        return Arrival(stamp, stamp, "/p", "lidar", str(k), broken if k == 2 else lambda: Frame(points))

    times, ids, notices = (0.0, 0.1, 0.2, 0.3, 9.0, 3.0), [], []
    report = run_stream(
        [arrival(k, t) for k, t in enumerate(times)],
        detect,
        Tracker(),
        lambda sweep, tracks: ids.append(tracks.ids.tolist()),
        notice=notices.append,
    )
    assert ids == [[1], [1], [1], [2], [3]] and report.unreadable == ["2"]
    assert [text.split(":")[0] for text in notices] == ["left out", "4", "5"]


def test_real_time_drops_old_sweeps_and_keeps_the_newest() -> None:
    """50 sweeps 10 ms apart, 35 ms each: about every fourth is done, the last among them, and none is lost silently."""
    frame = Frame(torch.tensor([[10.0, 2, -1, 0]]))
    sweeps = [Arrival(k * 10_000_000, k * 10_000_000, "/p", "lidar", str(k), lambda: frame) for k in range(50)]
    dropped: list[str] = []
    done: list[str] = []
    for sweep in in_real_time(sweeps, lambda one: dropped.append(one.name)):
        time.sleep(0.035)
        done.append(sweep.name)
    assert sorted(map(int, done + dropped)) == list(range(50))
    assert done == sorted(done, key=int) and done[-1] == "49" and len(dropped) > 20
    unhurried = list(in_real_time(sweeps[:5], lambda one: pytest.fail("dropped"), speed=0.5))
    assert len(unhurried) == 5


def test_a_fault_of_the_recording_reaches_whoever_plays_it() -> None:
    def sweeps():
        yield Arrival(0, 0, "/p", "lidar", "0", lambda: Frame(torch.zeros(1, 4)))
        raise BeamboxError("drive.mcap is damaged")

    with pytest.raises(BeamboxError, match="is damaged"):
        list(in_real_time(sweeps(), lambda one: None))


def test_nothing_half_written_stays_after_a_fault(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), recording_writer(tmp_path / "boxes.mcap", {}) as write:
        write(Arrival(0, 0, "/p", "lidar", "0", lambda: Frame(torch.zeros(1, 4))), Tracker().update(Detections.empty()))
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    with (
        pytest.raises(BeamboxError, match=r"boxes are written into a \.mcap file"),
        recording_writer(tmp_path / "b.bag", {}),
    ):
        pass
