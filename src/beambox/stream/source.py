"""The sweeps of a recording or a folder in order, each read once, with its stamp, topic and frame id."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.formats.columns import decode, library
from beambox.data.formats.point_cloud2 import cloud_columns
from beambox.data.formats.recording import recording_of
from beambox.data.read_points import frame_from_columns
from beambox.infer.inputs import find_sweeps, read_sweep
from beambox.structures import Frame

__all__ = ["Arrival", "arrivals"]

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
_AND_RECORD = ", which publishes PointCloud2, and record that"
PACKETS = {
    "velodyne_msgs/msg/VelodyneScan": f"packets of Velodyne; play them through velodyne_pointcloud{_AND_RECORD}",
    "livox_ros_driver/msg/CustomMsg": f"messages of Livox; run livox_ros_driver with xfer_format 0{_AND_RECORD}",
    "livox_ros_driver2/msg/CustomMsg": f"messages of Livox; run livox_ros_driver2 with xfer_format 0{_AND_RECORD}",
    "ouster_ros/msg/PacketMsg": f"packets of Ouster; play them through ouster_ros (replay){_AND_RECORD}",
    "ouster_sensor_msgs/msg/PacketMsg": f"packets of Ouster; play them through ouster_ros (replay){_AND_RECORD}",
}
"""Messages that hold points in a driver's own form, and what turns them into clouds."""


@dataclass(frozen=True)
class Arrival:
    """A sweep as it arrives; it is decoded only where it is looked at."""

    time: int
    """Nanoseconds at which it was recorded."""
    stamp: int
    """Nanoseconds of its header."""
    topic: str
    frame_id: str
    name: str
    read: Callable[[], Frame]
    """Decodes the points.

    Raises:
        BeamboxError: if they cannot be.
    """


def arrivals(
    path: Path, topic: str = "", *, rate: float = 10.0, fields: str | None = None, intensity_scale: float | None = None
) -> Iterator[Arrival]:
    """Go through a recording (.bag, .mcap, .db3, a folder of rosbag2) once, or through a folder of sweeps by name.

    Args:
        path: the recording, or recording/topic; or a folder of sweeps.
        topic: of the point clouds, where the recording has several.
        rate: sweeps per second of a folder, whose files have no time.
        fields: names of columns, see :func:`beambox.data.read_points.read_frame`.
        intensity_scale: factor for the intensity.

    Raises:
        BeamboxError: if there are no point clouds, several topics of them, or the recording is damaged.
    """
    root = recording_of(path)
    if root is None:
        for k, sweep in enumerate(find_sweeps([path])):
            when = round(k * 1e9 / rate)

            def read(one: Any = sweep) -> Frame:
                return read_sweep(one, fields=fields, intensity_scale=intensity_scale)

            yield Arrival(when, when, "/points", "lidar", sweep.name, read)
        return
    inside = "/".join(path.relative_to(root).parts)
    yield from _recorded(root, (topic or inside).strip("/"), fields, intensity_scale)


def _recorded(root: Path, topic: str, fields: str | None, scale: float | None) -> Iterator[Arrival]:
    highlevel = library("rosbags.highlevel", root, "recordings")
    typesys = library("rosbags.typesys", root, "recordings")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    reader = highlevel.AnyReader([root], default_typestore=store)
    where = root if root.is_file() else root / "metadata.yaml"
    decode(where, "recording", reader.open)
    try:
        wanted = _choose(root, topic, reader.connections)
        messages = iter(reader.messages(wanted))
        number = 0
        while True:
            found = decode(where, "recording", lambda: next(messages, None))
            if found is None:
                return
            connection, time, raw = found
            yield _arrival(reader, connection, time, raw, f"{root.name} {connection.topic} {number}", fields, scale)
            number += 1
    finally:
        reader.close()


def _choose(root: Path, topic: str, connections: list[Any]) -> list[Any]:
    clouds = [one for one in connections if one.msgtype == POINT_CLOUD]
    topics = sorted({one.topic.strip("/") for one in clouds})
    if not topics:
        packets = [one for one in connections if one.msgtype in PACKETS]
        details = f"; {packets[0].topic} holds {PACKETS[packets[0].msgtype]}" if packets else ""
        raise BeamboxError(f"{root} holds no point cloud (no message of type {POINT_CLOUD}){details}")
    if not topic and len(topics) > 1:
        raise BeamboxError(f"{root} holds point clouds under {', '.join(topics)}; name one by --topic")
    chosen = topic or topics[0]
    if chosen not in topics:
        raise BeamboxError(
            f'{root} has no point clouds under "{chosen}"{did_you_mean(chosen, topics)}; it has {", ".join(topics)}'
        )
    return [one for one in clouds if one.topic.strip("/") == chosen]


def _arrival(
    reader: Any, connection: Any, time: int, raw: bytes, where: str, fields: str | None, scale: float | None
) -> Arrival:
    cache: list[Any] = []

    def message() -> Any:
        if not cache:
            cache.append(reader.deserialize(raw, connection.msgtype))
        return cache[0]

    try:
        header = message().header
        stamp, frame_id = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec, str(header.frame_id)
    except Exception:  # a damaged message is told when it is read
        cache.clear()
        stamp, frame_id = time, ""
    name = f"{stamp or time}"

    def read() -> Frame:
        try:
            cloud = message()
        except Exception as error:  # the library raises nearly anything where the content is broken
            raise BeamboxError(f"{where} is damaged ({type(error).__name__})") from error
        frame = frame_from_columns(cloud_columns(cloud, where), where, fields=fields, intensity_scale=scale)
        return replace(frame, id=name)

    return Arrival(time, stamp or time, connection.topic, frame_id, name, read)
