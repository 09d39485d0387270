"""JSON label formats with all frames in one file.

* Datumaro (datumaro format, CVAT's cuboids): ``categories.label.labels`` and ``items`` with ``cuboid_3d`` annotations:
  position, rotation (radians), scale along the box's own x, y, z.
* Segments.ai (docs.segments.ai, label types): ``annotations`` with category_id, position, dimensions, yaw or a
  quaternion qx, qy, qz, qw; a sequence has ``frames``; a release has ``dataset.samples`` and the
  names of its categories.
* Scale (docs.scale.com, lidar callback format): a list of frames with ``cuboids``: position, dimensions x (width),
  y (length), z, and yaw from +y counter-clockwise.
* OpenLABEL (ASAM OpenLABEL 1.0): ``openlabel.frames.N.objects.ID.object_data.cuboid`` with ``val``: x, y, z, then a
  quaternion qx, qy, qz, qw or three angles, then sizes along the box's own x, y, z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from beambox.checks import BeamboxError
from beambox.data.labels.frames import LabeledFrame, Reader, member, vector
from beambox.geometry.angles import wrap

__all__ = [
    "format_datumaro",
    "format_openlabel",
    "format_scale",
    "format_segments",
    "parse_datumaro",
    "parse_openlabel",
    "parse_scale",
    "parse_segments",
]

Frames = Mapping[str, LabeledFrame]
QUATERNION = ("qx", "qy", "qz", "qw")


def parse_datumaro(content: Any, reader: Reader, frame: str) -> None:
    """Read all items; ``frame`` is not needed, as items have names."""
    categories = member(member(content, "categories", dict, reader.where), "label", dict, f"{reader.where}, categories")
    labels = member(categories, "labels", list, f"{reader.where}, categories.label")
    names = [str(one.get("name", "")) if isinstance(one, Mapping) else str(one) for one in labels]
    for k, item in enumerate(member(content, "items", list, reader.where)):
        where = f"{reader.where}, items[{k}]"
        own = str(member(item, "id", (str, int), where))
        reader.frame(own)
        for j, one in enumerate(member(item, "annotations", list, where)):
            place = f"items[{k}].annotations[{j}]"
            if not isinstance(one, Mapping) or one.get("type") != "cuboid_3d":
                continue
            number = member(one, "label_id", int, f"{reader.where}, {place}")
            if not 0 <= number < len(names):
                raise BeamboxError(f"{reader.where}, {place}: label_id {number} is not one of {len(names)} labels")
            position, rotation, scale = (
                member(one, key, list, f"{reader.where}, {place}") for key in ("position", "rotation", "scale")
            )
            if not len(position) == len(rotation) == len(scale) == 3:
                raise BeamboxError(f"{reader.where}, {place}: position, rotation and scale have three numbers each")
            reader.lean(*_floats(rotation[:2], f"{reader.where}, {place}"))
            attributes = one.get("attributes")
            identity = attributes.get("track_id", "") if isinstance(attributes, Mapping) else ""
            reader.add(own, names[number], [*position, *scale, rotation[2]], place, identity)


def format_datumaro(frames: Frames) -> Any:
    """Return all frames as Datumaro's JSON."""
    names = _names(frames)
    items = []
    for name, frame in frames.items():
        annotations = [
            {
                "id": k,
                "type": "cuboid_3d",
                "attributes": {"track_id": identity} if identity else {},
                "group": 0,
                "label_id": names.index(label),
                "position": box[:3],
                "rotation": [0.0, 0.0, box[6]],
                "scale": box[3:6],
            }
            for k, (label, box, identity) in enumerate(
                zip(frame.names, frame.boxes.tolist(), frame.ids or ("",) * len(frame))
            )
        ]
        items.append({"id": name, "annotations": annotations, "point_cloud": {"path": ""}})
    labels = [{"name": name, "parent": "", "attributes": []} for name in names]
    return {"info": {}, "categories": {"label": {"labels": labels, "attributes": []}}, "items": items}


def parse_segments(content: Any, reader: Reader, frame: str) -> None:
    """Read a label, a sequence, or a release; a category without a name is called by its number."""
    dataset = content.get("dataset") if isinstance(content, Mapping) else None
    if dataset is None:
        _segments_label(content, reader, frame, "", _categories(content))
        return
    names = _categories(dataset)
    for k, sample in enumerate(member(dataset, "samples", list, f"{reader.where}, dataset")):
        begin = f"dataset.samples[{k}]"
        name = str(member(sample, "name", str, f"{reader.where}, {begin}"))
        labels = member(sample, "labels", dict, f"{reader.where}, {begin}")
        label = next((one for one in labels.values() if one), None)
        if label is not None:
            attributes = member(label, "attributes", dict, f"{reader.where}, {begin}.labels")
            _segments_label(attributes, reader, name, f"{begin}.", names)


def _categories(content: Any) -> dict[int, str]:
    given = content.get("task_attributes", content) if isinstance(content, Mapping) else {}
    listed = given.get("categories") if isinstance(given, Mapping) else None
    return {
        one["id"]: str(one["name"]) for one in listed or [] if isinstance(one, Mapping) and {"id", "name"} <= {*one}
    }


def _segments_label(content: Any, reader: Reader, frame: str, begin: str, names: Mapping[int, str]) -> None:
    if isinstance(content, Mapping) and isinstance(content.get("frames"), list):
        for k, one in enumerate(content["frames"]):
            own = one.get("frame_name") or one.get("name") if isinstance(one, Mapping) else None
            name = str(own) if own else f"{frame}_{k:04d}"
            _segments_label(one, reader, name, f"{begin}frames[{k}].", names)
        return
    reader.frame(frame)
    for k, one in enumerate(member(content, "annotations", list, f"{reader.where}, {begin}".rstrip(" ,."))):
        place = f"{begin}annotations[{k}]"
        where = f"{reader.where}, {place}"
        if not isinstance(one, Mapping) or not str(one.get("type", "cuboid")).startswith("cuboid"):
            continue
        yaw = one.get("yaw")
        if isinstance(one.get("rotation"), Mapping):
            yaw = _heading(_floats(vector(one, "rotation", where, QUATERNION), where), reader, where)
        category = member(one, "category_id", int, where)
        numbers = [*vector(one, "position", where), *vector(one, "dimensions", where), yaw]
        reader.add(frame, names.get(category, str(category)), numbers, place, one.get("track_id", one.get("id", "")))


def format_segments(frames: Frames) -> Any:
    """Return all frames as a sequence, with the names of the categories beside it."""
    names = _names(frames)
    listed = []
    numbers: dict[str, int] = {}
    for name, frame in frames.items():
        annotations = []
        for label, box, identity in zip(frame.names, frame.boxes.tolist(), frame.identities()):
            number = int(identity) if identity.isdecimal() else numbers.setdefault(identity, 1_000_000 + len(numbers))
            annotations.append(
                {
                    "id": number,
                    "track_id": number,
                    "category_id": names.index(label) + 1,
                    "type": "cuboid",
                    "position": dict(zip("xyz", box[:3])),
                    "dimensions": dict(zip("xyz", box[3:6])),
                    "yaw": box[6],
                }
            )
        listed.append({"frame_name": name, "format_version": "0.2", "annotations": annotations})
    categories = [{"id": k, "name": name} for k, name in enumerate(names, start=1)]
    return {"format_version": "0.2", "categories": categories, "frames": listed}


def parse_scale(content: Any, reader: Reader, frame: str) -> None:
    """Read a list of frames (named by their position, or as our own files name them), or one frame."""
    listed = content if isinstance(content, list) else [content]
    single = not isinstance(content, list)
    quarter = 90.0 if reader.degrees else math.pi / 2
    for k, one in enumerate(listed):
        begin = "" if single else f"[{k}]."
        own = one.get("frame") if isinstance(one, Mapping) else None
        name = str(own) if own is not None else frame if single else f"{k:06d}"
        reader.frame(name)
        for j, cuboid in enumerate(member(one, "cuboids", list, f"{reader.where}, {begin}".rstrip(" ,."))):
            place = f"{begin}cuboids[{j}]"
            where = f"{reader.where}, {place}"
            width, length, height = vector(cuboid, "dimensions", where)
            yaw = _floats([cuboid.get("yaw")], where)[0] + quarter
            numbers = [*vector(cuboid, "position", where), length, width, height, yaw]
            reader.add(name, cuboid.get("label"), numbers, place, cuboid.get("uuid", ""))


def format_scale(frames: Frames) -> Any:
    """Return all frames as a list; each also says its name."""
    return [
        {
            "frame": name,
            "cuboids": [
                {
                    "uuid": identity,
                    "label": label,
                    "position": dict(zip("xyz", box[:3])),
                    "dimensions": dict(zip("xyz", (box[4], box[3], box[5]))),
                    "yaw": wrap(box[6] - math.pi / 2),
                }
                for label, box, identity in zip(frame.names, frame.boxes.tolist(), frame.identities())
            ],
        }
        for name, frame in frames.items()
    ]


def parse_openlabel(content: Any, reader: Reader, frame: str) -> None:
    """Read the cuboids of all frames."""
    root = member(content, "openlabel", dict, reader.where)
    objects = root.get("objects", {})
    for number, one in member(root, "frames", dict, f"{reader.where}, openlabel").items():
        properties = one.get("frame_properties") if isinstance(one, Mapping) else None
        own = properties.get("name") if isinstance(properties, Mapping) else None
        name = str(own) if own else str(number)
        reader.frame(name)
        for key, given in (one.get("objects") or {}).items() if isinstance(one, Mapping) else ():
            begin = f"openlabel.frames.{number}.objects.{key}"
            data = given.get("object_data", {}) if isinstance(given, Mapping) else {}
            known = objects.get(key, {}) if isinstance(objects, Mapping) else {}
            label = known.get("type") if isinstance(known, Mapping) else None
            cuboids = data.get("cuboid", []) if isinstance(data, Mapping) else []
            for k, cuboid in enumerate(cuboids if isinstance(cuboids, list) else [cuboids]):
                place = f"{begin}.cuboid[{k}]"
                where = f"{reader.where}, {place}"
                values = _floats(member(cuboid, "val", list, where), where)
                if len(values) == 10:
                    yaw = _heading(values[3:7], reader, where)
                elif len(values) == 9:
                    reader.lean(*values[3:5])
                    yaw = values[5]
                else:
                    raise BeamboxError(f"{where}.val: expected 9 or 10 numbers, got {len(values)}")
                reader.add(name, label, [*values[:3], *values[-3:], yaw], place, key)


def format_openlabel(frames: Frames) -> Any:
    """Return all frames; numbers count from 0, names stand in ``frame_properties``."""
    objects: dict[str, dict[str, str]] = {}
    listed: dict[str, Any] = {}
    for number, (name, frame) in enumerate(frames.items()):
        here: dict[str, Any] = {}
        for label, box, identity in zip(frame.names, frame.boxes.tolist(), frame.identities()):
            key = identity if frame.ids else f"{number}-{identity}"
            objects[key] = {"name": key, "type": label}
            cuboid = {"name": "shape", "val": [*box[:3], 0.0, 0.0, box[6], *box[3:6]]}
            here[key] = {"object_data": {"cuboid": [cuboid]}}
        listed[str(number)] = {"frame_properties": {"name": name}, "objects": here}
    return {"openlabel": {"metadata": {"schema_version": "1.0.0"}, "objects": objects, "frames": listed}}


def _heading(quaternion: list[float], reader: Reader, where: str) -> float:
    """Return the heading that a quaternion gives the box's x axis, in BEV, in the file's own angles."""
    length = math.sqrt(sum(value * value for value in quaternion))
    if not 0.9 < length < 1.1:
        raise BeamboxError(f"{where}: a quaternion must have length 1, got {length:g}")
    x, y, z, w = (value / length for value in quaternion)
    lean = math.acos(max(-1.0, min(1.0, 1 - 2 * (x * x + y * y))))
    yaw = math.atan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
    reader.lean(math.degrees(lean) if reader.degrees else lean)
    return math.degrees(yaw) if reader.degrees else yaw


def _floats(values: list[Any], where: str) -> list[float]:
    try:
        return [float(value) for value in values]
    except (TypeError, ValueError):
        raise BeamboxError(f"{where}: expected numbers, got {values!s:.80}") from None


def _names(frames: Frames) -> list[str]:
    return sorted({label for frame in frames.values() for label in frame.names})
