"""Recordings of ROS (.bag, .mcap, .db3, or a folder of rosbag2), through rosbags; each PointCloud2 message is a sweep.

A sweep in a recording has a path, though no file: recording / topic / nanoseconds of the message.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.formats.columns import Columns, decode, library
from beambox.data.formats.kept import kept_open

__all__ = ["ENDINGS", "read_message", "recording_of", "sweeps_in"]

ENDINGS = (".bag", ".mcap", ".db3")
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
NUMBERS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""Number types of a cloud's columns by PointField's ``datatype``, counted from 1."""


def recording_of(path: Path) -> Path | None:
    """Return the recording that a path names or lies in, or None."""
    return next((one for one in (path, *path.parents) if _is_recording(one)), None)


def _is_recording(path: Path) -> bool:
    if path.suffix.lower() in ENDINGS and path.is_file():
        return True
    return (path / "metadata.yaml").is_file() and any(path.glob(f"*{ending}") for ending in ENDINGS[1:])


def sweeps_in(path: Path) -> list[Path]:
    """List the sweeps of a recording, or of one of its topics, by time.

    Args:
        path: the recording, where it has point clouds under one topic alone; else recording / topic; or one sweep.

    Raises:
        BeamboxError: if it cannot be read, or which topic is meant does not follow from the path.
    """
    root, topic, stamp = _parts(path)
    if stamp is not None:
        return [path]

    def read() -> list[Path]:
        with kept_open(root, _reader) as reader:
            clouds = [one for one in reader.connections if one.msgtype == POINT_CLOUD]
            topics = sorted({one.topic.strip("/") for one in clouds})
            chosen = topics[0] if not topic and len(topics) == 1 else topic
            if not topics:
                raise BeamboxError(f"{root} holds no point cloud (no message of type {POINT_CLOUD})")
            if not chosen:
                raise BeamboxError(
                    f"{root} holds point clouds under {len(topics)} topics, {', '.join(topics)}; name one, as in "
                    f"{root / topics[0]}"
                )
            if chosen not in topics:
                raise BeamboxError(
                    f'{root} has no point clouds under "{chosen}"{did_you_mean(chosen, topics)}; it has '
                    f"{', '.join(topics)}"
                )
            wanted = [one for one in clouds if one.topic.strip("/") == chosen]
            stamps = dict.fromkeys(time for _, time, _ in reader.messages(wanted))
            return [root / chosen / str(time) for time in stamps]

    return decode(_file(root), "recording", read)


def read_message(path: Path) -> Columns:
    """Read the sweep at recording / topic / nanoseconds.

    Raises:
        BeamboxError: if there is no such message, or it cannot be read.
    """
    root, topic, stamp = _parts(path)
    if stamp is None:
        raise BeamboxError(
            f"{path} is a recording of many sweeps; name one as {root / (topic or 'TOPIC') / 'NANOSECONDS'}, or give "
            "the recording to `beambox detect`, which takes all"
        )

    def read() -> Columns:
        with kept_open(root, _reader) as reader:
            wanted = [one for one in reader.connections if one.topic.strip("/") == topic]
            for connection, _, raw in reader.messages(wanted, start=stamp, stop=stamp + 1) if wanted else ():
                return _columns(reader.deserialize(raw, connection.msgtype), path)
        raise BeamboxError(f'{root} has no message under "{topic}" at {stamp} ns')

    return decode(_file(root), "recording", read)


def _parts(path: Path) -> tuple[Path, str, int | None]:
    """Split a path into the recording, the topic without its first slash, and the time."""
    root = recording_of(path)
    if root is None:
        raise BeamboxError(f"{path} is not in a recording ({', '.join(ENDINGS)}, or a folder of rosbag2)")
    inside = path.relative_to(root).parts
    if len(inside) > 1 and inside[-1].isdigit():
        return root, "/".join(inside[:-1]), int(inside[-1])
    return root, "/".join(inside), None


def _file(root: Path) -> Path:
    return root if root.is_file() else root / "metadata.yaml"


def _reader(root: Path) -> Any:
    """Make a reader of a recording; older ones, without definitions of their types, hold ROS 2's own."""
    highlevel = library("rosbags.highlevel", root, "recordings")
    typesys = library("rosbags.typesys", root, "recordings")
    return highlevel.AnyReader([root], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))


def _columns(cloud: Any, path: Path) -> Columns:
    """Take the columns of one number a point out of a PointCloud2 message; rows may end in padding."""
    fields = [field for field in cloud.fields if field.count == 1 and field.name]
    order = ">" if cloud.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + NUMBERS[field.datatype - 1] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": cloud.point_step,
        }
    )
    data = np.asarray(cloud.data, dtype=np.uint8)
    if len(data) < cloud.height * cloud.row_step:
        raise BeamboxError(f"{path} is cut short: {cloud.height * cloud.row_step} bytes promised, {len(data)} there")
    rows = data[: cloud.height * cloud.row_step].reshape(cloud.height, cloud.row_step)
    points = np.frombuffer(rows[:, : cloud.width * cloud.point_step].tobytes(), dtype=layout)
    return Columns(layout.names or (), [points[name] for name in layout.names or ()])
