"""Recordings of ROS (.bag, .mcap, .db3, or a folder of rosbag2), through rosbags; each PointCloud2 message is a sweep.

A sweep in a recording has a path, though no file: recording / topic / nanoseconds of the message; where several
messages have one time, the second is called nanoseconds-2.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.formats.columns import Columns, decode, library
from beambox.data.formats.kept import kept_open
from beambox.data.formats.point_cloud2 import cloud_columns
from beambox.data.formats.unpacking import bound_rosbags
from beambox.file_names import check_file_name

__all__ = ["ENDINGS", "read_message", "recording_of", "sweeps_in"]

ENDINGS = (".bag", ".mcap", ".db3")
LOW_LEVEL = ("rosbag1.reader", "rosbag2.reader", "rosbag2.storage_mcap")
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
STAMP = re.compile(r"([0-9]{1,19})(?:-([0-9]{1,9}))?")


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
            for part in chosen.split("/"):
                check_file_name(part, f"{root}, the topic {chosen[:60]!a}")
            wanted = [one for one in clouds if one.topic.strip("/") == chosen]
            repeats: Counter[int] = Counter()
            found = []
            for _, time, _ in reader.messages(wanted):
                repeats[time] += 1
                found.append(root / chosen / (str(time) if repeats[time] == 1 else f"{time}-{repeats[time]}"))
            return found

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
            time, number = stamp
            messages: Any = reader.messages(wanted, start=time, stop=time + 1) if wanted else ()
            for connection, _, raw in itertools.islice(messages, number - 1, None):
                return cloud_columns(reader.deserialize(raw, connection.msgtype), str(path))
        which = f"{time} ns" if number == 1 else f"{time} ns, the {number}th at that time"
        raise BeamboxError(f'{root} has no message under "{topic}" at {which}')

    return decode(_file(root), "recording", read)


def _parts(path: Path) -> tuple[Path, str, tuple[int, int] | None]:
    """Split a path into the recording, the topic without its first slash, the time and which message of that time."""
    root = recording_of(path)
    if root is None:
        raise BeamboxError(f"{path} is not in a recording ({', '.join(ENDINGS)}, or a folder of rosbag2)")
    inside = path.relative_to(root).parts
    stamp = STAMP.fullmatch(inside[-1]) if len(inside) > 1 else None
    if stamp is not None:
        return root, "/".join(inside[:-1]), (int(stamp[1]), int(stamp[2] or 1))
    return root, "/".join(inside), None


def _file(root: Path) -> Path:
    return root if root.is_file() else root / "metadata.yaml"


def _reader(root: Path) -> Any:
    """Make a reader of a recording; older ones, without definitions of their types, hold ROS 2's own."""
    highlevel = library("rosbags.highlevel", root, "recordings")
    typesys = library("rosbags.typesys", root, "recordings")
    bound_rosbags(*(library(f"rosbags.{name}", root, "recordings") for name in LOW_LEVEL))
    return highlevel.AnyReader([root], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
