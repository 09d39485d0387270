"""PointCloud2 headers as drivers really fill them in: the points are all there, or the file is refused, with a word."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from beambox.checks import BeamboxError
from beambox.data.formats.point_cloud2 import cloud_columns

N, STEP = 10, 32
XYZ = np.random.default_rng(1).uniform(-20, 20, (N, 3)).astype("<f4")
FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7))


def packed(step: int = STEP, order: str = "<") -> np.ndarray:
    records = np.zeros((N, step), np.uint8)
    for offset, column in zip((0, 4, 8, 16), (*XYZ.T, np.arange(N) * 20.0)):
        records[:, offset : offset + 4] = np.ascontiguousarray(column, order + "f4").view(np.uint8).reshape(N, 4)
    return records.reshape(-1)


def field(name: str, offset: int, datatype: int, count: int = 1) -> SimpleNamespace:
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def cloud(**changes: Any) -> SimpleNamespace:
    cloud_message = {
        "height": 1, "width": N, "fields": [field(*one) for one in FIELDS], "is_bigendian": False, "point_step": STEP,
        "row_step": N * STEP, "data": packed(), "is_dense": True,
    }  # fmt: skip
    return SimpleNamespace(**{**cloud_message, **changes})


def check(cloud_message: SimpleNamespace, note: str = "") -> None:
    columns = cloud_columns(cloud_message, "a.bag")
    found = dict(zip(columns.names, columns.arrays))
    assert np.array_equal(np.stack([found[axis] for axis in "xyz"], axis=1), XYZ)
    assert found["intensity"].tolist() == [20 * k for k in range(N)]
    assert note in " ".join(columns.notes) and bool(note) == bool(columns.notes)


@pytest.mark.parametrize("row_step", [0, 1, N, 22, N * STEP + 1, 12 * STEP, 2**32 - 1])
@pytest.mark.parametrize("height", [1, 2, 5])
def test_row_step_is_not_trusted_where_the_rest_agrees(row_step: int, height: int) -> None:
    check(cloud(height=height, width=N // height, row_step=row_step))


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ({"height": 0}, "height is 0"),
        ({"height": N, "width": 0}, "width 0"),
        ({"point_step": 0}, "point_step is 0"),
        ({"point_step": 16}, "point_step is 16"),
        ({"is_bigendian": True}, "is_bigendian is True"),
        ({"data": packed(order=">")}, "is_bigendian is False"),
        ({"is_dense": False}, ""),
        ({"fields": [field(*one, count=0) for one in FIELDS]}, ""),
        ({"fields": [field(*one, count=N) for one in FIELDS]}, ""),
        ({"fields": [*(field(*one) for one in FIELDS), field("", 20, 7), field("_", 24, 7)]}, ""),
        ({"fields": [*(field(*one) for one in FIELDS), field("x", 20, 7)]}, "'x' stands there twice"),
        ({"fields": [*(field(*one) for one in FIELDS), field("odd", 20, 9)]}, "'odd' has datatype 9"),
        ({"fields": [*(field(*one) for one in FIELDS), field("hist", 20, 2, 12)]}, "'hist' holds 12 numbers"),
        ({"data": np.concatenate((packed(), np.zeros(5, np.uint8)))}, ""),
    ],
)
def test_headers_that_are_wrong_somewhere(changes: dict[str, Any], note: str) -> None:
    check(cloud(**changes), note)


@pytest.mark.parametrize(("row_step", "note"), [(5 * STEP + 6, ""), (22, "the data have rows of 166 bytes")])
@pytest.mark.parametrize("last", [True, False])
def test_rows_that_end_in_padding(row_step: int, note: str, last: bool) -> None:
    rows = np.concatenate((packed().reshape(2, -1), np.zeros((2, 6), np.uint8)), axis=1).reshape(-1)
    cloud_message = cloud(height=2, width=5, row_step=row_step, data=rows if last else rows[:-6])
    check(cloud_message, note)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 1}, "does not explain them; the header is wrong, and points would be lost"),
        ({"width": 11}, "is cut short"),
        ({"height": 2**31}, "is cut short"),
        ({"height": 0, "width": 0}, "means no point, but there are 320 bytes"),
        ({"fields": [field(n, o, 0 if n == "x" else d) for n, o, d in FIELDS]}, "'x' has datatype 0"),
        ({"fields": [field(n, o, 200 if n == "z" else d) for n, o, d in FIELDS]}, "'z' has datatype 200"),
        ({"fields": [field(n, 0, d) for n, o, d in FIELDS]}, "must lie at different offsets"),
        ({"fields": [field(n, o + 100, d) for n, o, d in FIELDS]}, "its fields reach to byte 120"),
    ],
)
def test_what_cannot_be_explained_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        cloud_columns(cloud(**changes), "a.bag")


def test_a_message_without_points() -> None:
    columns = cloud_columns(cloud(width=0, data=np.zeros(0, np.uint8), row_step=0), "a.bag")
    assert len(columns) == 0 and columns.names[:3] == ("x", "y", "z")


def test_two_messages_of_one_time_are_two_sweeps(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    from beambox.data.read_points import read_frame
    from beambox.infer.inputs import find_sweeps

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
    with Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
        for k in range(3):
            cloud_message = vars(cloud(data=packed() if k != 1 else packed()[::-1].copy()))
            cloud_message["fields"] = [
                types["sensor_msgs/msg/PointField"](**vars(one)) for one in cloud_message["fields"]
            ]
            head = types["std_msgs/msg/Header"](seq=0, stamp=time, frame_id="l")
            message = types["sensor_msgs/msg/PointCloud2"](header=head, **cloud_message)
            writer.write(connection, 5, store.serialize_ros1(message, "sensor_msgs/msg/PointCloud2"))
    found = find_sweeps([tmp_path / "a.bag"])
    assert [sweep.name for sweep in found] == ["5", "5-2", "5-3"]
    first, third = read_frame(found[0].path), read_frame(found[2].path)
    assert len(first) == len(third) == N and first.id == "5" and third.id == "5-3"
    with pytest.raises(BeamboxError, match="the 4th at that time"):
        read_frame(found[0].path.with_name("5-4"))
