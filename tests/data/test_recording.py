"""Point clouds of ROS recordings, written by rosbags and read back."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.formats.recording import sweeps_in
from beambox.data.read_points import read_frame
from beambox.infer.inputs import find_sweeps, read_sweep
from beambox.infer.predictor import Detector
from oracles.tiny_detector import tiny_model

pytest.importorskip("rosbags")

from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 2), ("ring", 18, 4))
STEP, PADDING = 22, 6


def points(seed: int, rows: int = 2, width: int = 5) -> np.ndarray:
    numbers = ["<f4"] * 3 + ["u1", "<u2"]
    names, offsets, _ = zip(*FIELDS)
    layout = np.dtype({"names": names, "formats": numbers, "offsets": offsets, "itemsize": STEP})
    rng = np.random.default_rng(seed)
    structured = np.zeros((rows, width), layout)
    for name in "xyz":
        structured[name] = rng.uniform(-20, 20, (rows, width))
    structured["intensity"] = rng.integers(0, 256, (rows, width))
    structured["ring"] = rng.integers(0, 64, (rows, width))
    return structured


def message(store: Any, cloud: np.ndarray, ros1: bool) -> Any:
    types = store.types
    rows, width = cloud.shape
    data = np.zeros((rows, width * STEP + PADDING), np.uint8)
    data[:, : width * STEP] = np.frombuffer(cloud.tobytes(), np.uint8).reshape(rows, -1)
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    header = {"stamp": time, "frame_id": "lidar", **({"seq": 0} if ros1 else {})}
    return types["sensor_msgs/msg/PointCloud2"](
        header=types["std_msgs/msg/Header"](**header),
        height=rows,
        width=width,
        fields=[types["sensor_msgs/msg/PointField"](name=n, offset=o, datatype=d, count=1) for n, o, d in FIELDS],
        is_bigendian=False,
        point_step=STEP,
        row_step=width * STEP + PADDING,
        data=data.reshape(-1),
        is_dense=True,
    )


def record(folder: Path, kind: str, topics: tuple[str, ...] = ("/lidar/top",)) -> Path:
    """Write three sweeps a topic, 100 ms apart; returns the recording."""
    if kind == "bag":
        store = get_typestore(Stores.ROS1_NOETIC)
        path = folder / "drive.bag"
        writer, write = Writer1(path), store.serialize_ros1
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        path = folder / "drive"
        plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
        writer, write = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    with writer:
        for topic in topics:
            connection = writer.add_connection(topic, "sensor_msgs/msg/PointCloud2", typestore=store)
            for k in range(3):
                structured = message(store, points(k), kind == "bag")
                writer.write(connection, 10**9 + k * 10**8, write(structured, "sensor_msgs/msg/PointCloud2"))
    return next(path.glob("*.mcap")) if kind == "mcap file" else path


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap", "mcap file"])
def test_sweeps_of_a_recording_come_back(kind: str, tmp_path: Path) -> None:
    path = record(tmp_path, kind)
    found = find_sweeps([path])
    assert [sweep.name for sweep in found] == ["1000000000", "1100000000", "1200000000"]
    assert [sweep.path for sweep in find_sweeps([path / "lidar" / "top"])] == [sweep.path for sweep in found]
    for k, sweep in enumerate(found):
        assert sweep.path.parent == path / "lidar" / "top"
        frame, expected = read_sweep(sweep), points(k).reshape(-1)
        assert np.array_equal(frame.points[:, :3].numpy(), np.stack([expected[name] for name in "xyz"], axis=1))
        assert np.allclose(frame.points[:, 3].numpy(), expected["intensity"] / 255)
        assert frame.id == sweep.name and frame.notes == ("intensity divided by 255",)
    ringed = read_frame(found[1].path, fields="x,y,z,intensity,ring")
    assert np.array_equal(ringed.points[:, 4].numpy(), points(1)["ring"].reshape(-1))
    assert find_sweeps([found[2].path])[0].path == found[2].path


def test_recordings_lie_among_other_sweeps(tmp_path: Path) -> None:
    record(tmp_path, "bag")
    np.save(tmp_path / "a.npy", np.zeros((3, 4), np.float32))
    assert [sweep.name for sweep in find_sweeps([tmp_path])] == ["a", "1000000000", "1100000000", "1200000000"]


def test_of_several_topics_one_must_be_named(tmp_path: Path) -> None:
    path = record(tmp_path, "bag", ("/left", "/right"))
    with pytest.raises(BeamboxError, match=r"under 2 topics, left, right; name one, as in .*drive\.bag.left"):
        sweeps_in(path)
    assert len(sweeps_in(path / "right")) == 3
    with pytest.raises(BeamboxError, match=r'no point clouds under "rihgt" \(did you mean "right"\?\); it has left'):
        sweeps_in(path / "rihgt")


def test_what_cannot_be_read_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = record(tmp_path, "bag")
    with pytest.raises(BeamboxError, match=r"is a recording of many sweeps; name one as .*NANOSECONDS, or give"):
        read_frame(path)
    with pytest.raises(BeamboxError, match='has no message under "lidar/top" at 5 ns'):
        read_frame(path / "lidar" / "top" / "5")
    broken = tmp_path / "broken.bag"
    broken.write_bytes(path.read_bytes()[:200])
    with pytest.raises(BeamboxError, match=r"broken\.bag is not a readable recording, or is damaged"):
        sweeps_in(broken)

    def absent(name: str) -> ModuleType:
        raise ImportError(name)

    monkeypatch.setattr("beambox.checks.importlib.import_module", absent)
    with pytest.raises(
        BeamboxError,
        match=r'needs the library rosbags, which is not installed: python -m pip install "\.\[recordings\]"',
    ):
        sweeps_in(path)


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_a_recording_is_opened_once_for_all_its_sweeps(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record(tmp_path, kind)
    opened, closed = [], []
    for name, calls in (("open", opened), ("close", closed)):
        real = getattr(AnyReader, name)
        monkeypatch.setattr(AnyReader, name, lambda self, real=real, calls=calls: (calls.append(self), real(self))[1])
    detector = Detector(tiny_model(), device="cpu", precision="float32")
    assert [found.frame_id for found in detector.stream(path)] == ["1000000000", "1100000000", "1200000000"]
    assert len(opened) == 1 and closed[-1:] == opened
    assert len(detector(path)) == 3 and len(detector([path, path / "lidar" / "top" / "1100000000"])) == 4
    assert detector(path / "lidar" / "top" / "1100000000").frame_id == "1100000000"


def test_a_recording_written_anew_is_opened_anew(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    path = record(tmp_path / "one", "bag")
    before = read_sweep(find_sweeps([path])[0])
    other = record(tmp_path / "two", "bag", ("/other",))
    other.replace(path)
    assert find_sweeps([path])[0].path.parent == path / "other"
    assert torch.equal(read_sweep(find_sweeps([path])[0]).points, before.points)
