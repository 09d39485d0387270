"""JSON label formats of annotation tools with one file per frame.

* SUSTechPOINTS (naurril/SUSTechPOINTS): a list of ``obj_type``, ``obj_id``, ``psr``: position, scale, rotation
  (radians).
* labelCloud (ch-sa/labelCloud, docs/conventions.md): ``objects`` with ``centroid``, ``dimensions``, ``rotations`` in
  degrees (centroid_abs) or radians (centroid_rel), or with eight ``vertices``: 0 to 3 is the length, 0 to 1 the width,
  0 to 4 the height; the object looks from 0 to 3.
* Supervisely (developer.supervisely.com, point cloud annotation): ``objects`` with key and classTitle, ``figures`` with
  objectKey and ``cuboid_3d`` geometry: position, rotation (radians), dimensions along the box's own x, y, z; an episode
  has its figures under ``frames``.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.labels.frames import LabeledFrame, Reader, member, vector

__all__ = [
    "format_labelcloud",
    "format_supervisely",
    "format_sustechpoints",
    "parse_labelcloud",
    "parse_supervisely",
    "parse_sustechpoints",
]

CORNERS = np.array(
    [[-1, -1, -1], [-1, 1, -1], [1, 1, -1], [1, -1, -1], [-1, -1, 1], [-1, 1, 1], [1, 1, 1], [1, -1, 1]],
    dtype=np.float64,
)
"""labelCloud's order of the corners: x along the length, y along the width."""
NAMESPACE = uuid.UUID("6ba7b812-9dad-11d1-80b4-00c04fd430c8")
SIZES = ("length", "width", "height")


def parse_sustechpoints(content: Any, reader: Reader, frame: str) -> None:
    """Read the objects of one frame."""
    objects = content.get("objs") if isinstance(content, Mapping) else content
    if not isinstance(objects, list):
        raise BeamboxError(f"{reader.where}: expected a list of objects with obj_type and psr")
    reader.frame(frame)
    for k, one in enumerate(objects):
        place = f"[{k}]"
        where = f"{reader.where}, {place}"
        psr = member(one, "psr", dict, where)
        roll, pitch, yaw = _angles(vector(psr, "rotation", where), where)
        reader.lean(roll, pitch)
        numbers = [*vector(psr, "position", where), *vector(psr, "scale", where), yaw]
        reader.add(frame, one.get("obj_type"), numbers, place, one.get("obj_id", ""))


def format_sustechpoints(frame: LabeledFrame) -> Any:
    """Return the objects of one frame."""
    return [
        {
            "obj_id": identity,
            "obj_type": name,
            "psr": {
                "position": _xyz(box[:3]),
                "rotation": _xyz([0.0, 0.0, box[6]]),
                "scale": _xyz(box[3:6]),
            },
        }
        for name, box, identity in zip(frame.names, frame.boxes.tolist(), frame.identities())
    ]


def parse_labelcloud(content: Any, reader: Reader, frame: str) -> None:
    """Read the objects of one frame, by centroid or by vertices."""
    reader.frame(frame)
    for k, one in enumerate(member(content, "objects", list, reader.where)):
        place = f"objects[{k}]"
        where = f"{reader.where}, {place}"
        if isinstance(one, Mapping) and "vertices" in one:
            numbers = _from_vertices(one["vertices"], where)
            if reader.degrees:
                numbers[6] = math.degrees(numbers[6])
        else:
            roll, pitch, yaw = _angles(vector(one, "rotations", where), where)
            reader.lean(roll, pitch)
            numbers = [*vector(one, "centroid", where), *vector(one, "dimensions", where, SIZES), yaw]
        reader.add(frame, one.get("name"), numbers, place)


def format_labelcloud(frame: LabeledFrame, name: str, angle: Callable[[float], float] | None) -> Any:
    """Return the objects of one frame.

    Args:
        frame: the boxes.
        name: of the frame; the point cloud's file is not known here.
        angle: turns radians into the file's angles; None writes vertices.
    """
    objects = []
    for label, box in zip(frame.names, frame.boxes.tolist()):
        if angle is None:
            objects.append({"name": label, "vertices": _vertices(box)})
            continue
        rotations = _xyz([0.0, 0.0, angle(box[6])])
        sizes = dict(zip(SIZES, box[3:6]))
        objects.append({"name": label, "centroid": _xyz(box[:3]), "dimensions": sizes, "rotations": rotations})
    return {"folder": "", "filename": name, "path": name, "objects": objects}


def parse_supervisely(content: Any, reader: Reader, frame: str) -> None:
    """Read the annotation of a point cloud, or of an episode, whose frames are named by their index."""
    known: dict[str, str] = {}
    for k, one in enumerate(member(content, "objects", list, reader.where)):
        for key in ("key", "id"):
            if isinstance(one, Mapping) and one.get(key) is not None:
                known[str(one[key])] = member(one, "classTitle", str, f"{reader.where}, objects[{k}]")
    if "frames" not in content:
        reader.frame(frame)
        _figures(content, reader, frame, "", known)
        return
    for k, one in enumerate(member(content, "frames", list, reader.where)):
        index = member(one, "index", int, f"{reader.where}, frames[{k}]")
        reader.frame(str(index))
        _figures(one, reader, str(index), f"frames[{k}].", known)


def _figures(content: Any, reader: Reader, frame: str, begin: str, known: Mapping[str, str]) -> None:
    for k, one in enumerate(member(content, "figures", list, f"{reader.where}, {begin}".rstrip(" ,."))):
        place = f"{begin}figures[{k}]"
        where = f"{reader.where}, {place}"
        if not isinstance(one, Mapping) or one.get("geometryType", "cuboid_3d") != "cuboid_3d":
            continue
        owner = str(one.get("objectKey", one.get("objectId")))
        if owner not in known:
            raise BeamboxError(f"{where}: its object {owner!r:.60} is not among `objects`")
        geometry = member(one, "geometry", dict, where)
        roll, pitch, yaw = _angles(vector(geometry, "rotation", where), where)
        reader.lean(roll, pitch)
        numbers = [*vector(geometry, "position", where), *vector(geometry, "dimensions", where), yaw]
        reader.add(frame, known[owner], numbers, place, owner)


def format_supervisely(frame: LabeledFrame, name: str) -> Any:
    """Return the annotation of one point cloud; keys follow from its name and the identities."""
    objects, figures = [], []
    for k, (label, box, identity) in enumerate(zip(frame.names, frame.boxes.tolist(), frame.identities())):
        key = identity if _is_key(identity) else uuid.uuid5(NAMESPACE, f"{name}/{identity}/{k}").hex
        objects.append({"key": key, "classTitle": label, "tags": []})
        geometry = {
            "position": _xyz(box[:3]),
            "rotation": _xyz([0.0, 0.0, box[6]]),
            "dimensions": _xyz(box[3:6]),
        }
        own = uuid.uuid5(NAMESPACE, f"{name}/{key}/figure").hex
        figures.append({"key": own, "objectKey": key, "geometryType": "cuboid_3d", "geometry": geometry})
    head = {"description": "", "key": uuid.uuid5(NAMESPACE, name).hex, "tags": []}
    return {**head, "objects": objects, "figures": figures}


def _is_key(identity: str) -> bool:
    return len(identity) == 32 and all(letter in "0123456789abcdef" for letter in identity)


def _xyz(values: list[float]) -> dict[str, float]:
    return dict(zip("xyz", values))


def _angles(values: list[Any], where: str) -> tuple[float, float, float]:
    try:
        roll, pitch, yaw = (float(value) for value in values)
    except (TypeError, ValueError):
        raise BeamboxError(f"{where}: expected three angles, got {values!s:.80}") from None
    return roll, pitch, yaw


def _vertices(box: list[float]) -> list[list[float]]:
    x, y, z, length, width, height, yaw = box
    local = CORNERS * [length / 2, width / 2, height / 2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    across = sin * local[:, 0] + cos * local[:, 1]
    turned = np.stack((cos * local[:, 0] - sin * local[:, 1], across, local[:, 2]), axis=1)
    return np.add(turned, [x, y, z]).tolist()


def _from_vertices(given: Any, where: str) -> list[float]:
    try:
        corners = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.zeros(0)
    if corners.shape != (8, 3):
        raise BeamboxError(f"{where}: expected eight vertices of three numbers, got {given!s:.80}")
    along, across, up = corners[3] - corners[0], corners[1] - corners[0], corners[4] - corners[0]
    sizes = [float(np.linalg.norm(edge)) for edge in (along, across, up)]
    return [*corners.mean(axis=0).tolist(), *sizes, math.atan2(along[1], along[0])]
