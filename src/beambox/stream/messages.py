"""Boxes as messages of ROS 2 (MarkerArray, Detection3DArray; CDR) and Foxglove (SceneUpdate; protobuf).

Definitions: visualization_msgs as in ROS 2 Humble, vision_msgs 4 (ros-perception), foxglove.SceneUpdate (foxglove-sdk).
"""

from __future__ import annotations

import colorsys
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from beambox.data.formats.columns import library
from beambox.track.tracks import Tracks

__all__ = ["Kind", "kinds"]

Stamp = tuple[int, int]  # seconds, nanoseconds
ALPHA = 0.4
VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\n"
    "string id\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}


@dataclass(frozen=True)
class Kind:
    """One kind of message."""

    topic: str
    """Below the topic of the sweeps."""
    schema: str
    """Name of the type."""
    schema_encoding: str
    definition: bytes
    encoding: str
    encode: Callable[[Tracks, Stamp, str, float], bytes]
    """Tracks, stamp, frame id and lifetime in seconds -> the message."""


def kinds(out: Path) -> list[Kind]:
    """Return the kinds of messages that are written.

    Raises:
        BeamboxError: if a library is not installed.
    """
    typesys = library("rosbags.typesys", out, "recordings")
    foxglove = library("foxglove.messages", out, "recordings")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    added: dict[str, Any] = {}
    for name, text in VISION.items():
        added.update(typesys.get_types_from_msg(text, name))
    store.register(added)

    def ros(topic: str, name: str, build: Callable[[Any, Tracks, Stamp, str, float], Any]) -> Kind:
        def encode(tracks: Tracks, stamp: Stamp, frame_id: str, lifetime: float) -> bytes:
            return bytes(store.serialize_cdr(build(store.types, tracks, stamp, frame_id, lifetime), name))

        return Kind(topic, name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode(), "cdr", encode)

    schema = foxglove.SceneUpdate.get_schema()

    def scene(tracks: Tracks, stamp: Stamp, frame_id: str, lifetime: float) -> bytes:
        return _scene(foxglove, tracks, stamp, frame_id, lifetime)

    return [
        ros("markers", "visualization_msgs/msg/MarkerArray", _markers),
        ros("detections", "vision_msgs/msg/Detection3DArray", _detections),
        Kind("scene", schema.name, schema.encoding, bytes(schema.data), "protobuf", scene),
    ]


def _markers(types: Any, tracks: Tracks, stamp: Stamp, frame_id: str, lifetime: float) -> Any:
    make = _Ros(types, stamp, frame_id)
    life = types["builtin_interfaces/msg/Duration"](sec=int(lifetime), nanosec=int(lifetime % 1 * 1e9))
    markers = [make.marker("", 0, action=3, lifetime=life)]  # DELETEALL: what is gone is gone
    for number, name, box in _objects(tracks):
        red, green, blue = _color(name)
        color = types["std_msgs/msg/ColorRGBA"](r=red, g=green, b=blue, a=ALPHA)
        size = make.vector(*box[3:6])
        markers.append(make.marker(name, number, pose=make.pose(box), scale=size, color=color, lifetime=life))
    return types["visualization_msgs/msg/MarkerArray"](markers=markers)


def _detections(types: Any, tracks: Tracks, stamp: Stamp, frame_id: str, lifetime: float) -> Any:
    make = _Ros(types, stamp, frame_id)
    found = []
    for (number, name, box), score in zip(_objects(tracks), tracks.detections.scores.tolist()):
        pose = types["geometry_msgs/msg/PoseWithCovariance"](pose=make.pose(box), covariance=np.zeros(36))
        hypothesis = types["vision_msgs/msg/ObjectHypothesis"](class_id=name, score=score)
        result = types["vision_msgs/msg/ObjectHypothesisWithPose"](hypothesis=hypothesis, pose=pose)
        bbox = types["vision_msgs/msg/BoundingBox3D"](center=make.pose(box), size=make.vector(*box[3:6]))
        one = types["vision_msgs/msg/Detection3D"](
            header=make.header, results=[result], bbox=bbox, id=str(number) if number else ""
        )
        found.append(one)
    return types["vision_msgs/msg/Detection3DArray"](header=make.header, detections=found)


class _Ros:
    """Makes parts of ROS 2 messages."""

    def __init__(self, types: Any, stamp: Stamp, frame_id: str) -> None:
        self.types = types
        time = types["builtin_interfaces/msg/Time"](sec=stamp[0], nanosec=stamp[1])
        self.header = types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)

    def vector(self, x: float, y: float, z: float) -> Any:
        return self.types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)

    def pose(self, box: list[float]) -> Any:
        point = self.types["geometry_msgs/msg/Point"](x=box[0], y=box[1], z=box[2])
        sin, cos = math.sin(box[6] / 2), math.cos(box[6] / 2)
        turn = self.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=sin, w=cos)
        return self.types["geometry_msgs/msg/Pose"](position=point, orientation=turn)

    def marker(self, space: str, number: int, *, action: int = 0, lifetime: Any, **given: Any) -> Any:
        empty = np.zeros(0, np.uint8)
        image = self.types["sensor_msgs/msg/CompressedImage"](header=self.header, format="", data=empty)
        usual = {
            "pose": self.pose([0.0] * 7),
            "scale": self.vector(0.0, 0.0, 0.0),
            "color": self.types["std_msgs/msg/ColorRGBA"](r=0.0, g=0.0, b=0.0, a=0.0),
        }
        return self.types["visualization_msgs/msg/Marker"](
            header=self.header,
            ns=space,
            id=number,
            type=1,  # CUBE
            action=action,
            **{**usual, **given},
            lifetime=lifetime,
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource="",
            texture=image,
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=self.types["visualization_msgs/msg/MeshFile"](filename="", data=empty),
            mesh_use_embedded_materials=False,
        )


def _scene(make: Any, tracks: Tracks, stamp: Stamp, frame_id: str, lifetime: float) -> bytes:
    time = make.Timestamp(sec=stamp[0], nsec=stamp[1])
    life = make.Duration(sec=int(lifetime), nsec=int(lifetime % 1 * 1e9))
    entities = []
    for (number, name, box), score, speed in zip(
        _objects(tracks), tracks.detections.scores.tolist(), tracks.speeds.tolist()
    ):
        red, green, blue = _color(name)
        center = make.Vector3(x=box[0], y=box[1], z=box[2])
        turn = make.Quaternion(x=0.0, y=0.0, z=math.sin(box[6] / 2), w=math.cos(box[6] / 2))
        above = make.Vector3(x=box[0], y=box[1], z=box[2] + box[5] / 2 + 0.5)
        cube = make.CubePrimitive(
            pose=make.Pose(position=center, orientation=turn),
            size=make.Vector3(x=box[3], y=box[4], z=box[5]),
            color=make.Color(r=red, g=green, b=blue, a=ALPHA),
        )
        text = make.TextPrimitive(
            pose=make.Pose(position=above, orientation=make.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)),
            billboard=True,
            font_size=14.0,
            scale_invariant=True,
            color=make.Color(r=red, g=green, b=blue, a=1.0),
            text=f"{name} {number} {speed:.1f} m/s" if number else name,
        )
        pairs = {"class": name, "score": f"{score:.4f}", "speed": f"{speed:.3f}"}
        entities.append(
            make.SceneEntity(
                timestamp=time,
                frame_id=frame_id,
                id=f"{name}-{number}-{len(entities)}",
                lifetime=life,
                metadata=[make.KeyValuePair(key=key, value=value) for key, value in pairs.items()],
                cubes=[cube],
                texts=[text],
            )
        )
    everything = make.SceneEntityDeletion(timestamp=time, type=make.SceneEntityDeletionType.All, id="")
    return make.SceneUpdate(deletions=[everything], entities=entities).encode()


def _objects(tracks: Tracks) -> list[tuple[int, str, list[float]]]:
    """Return identity (0 where nothing was tracked), class and box of each object."""
    return list(zip(tracks.ids.tolist(), tracks.names, tracks.detections.boxes.tolist()))


def _color(name: str) -> tuple[float, float, float]:
    """Give every class a color of its own, the same everywhere."""
    known = SimpleNamespace(Car=0.58, Pedestrian=0.08, Cyclist=0.33)
    hue = getattr(known, name, None)
    return colorsys.hsv_to_rgb((zlib.crc32(name.encode()) % 360) / 360 if hue is None else hue, 0.8, 1.0)
