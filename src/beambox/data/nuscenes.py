"""nuScenes (v1.0 tables; docs/schema_nuscenes.md of its devkit): key frames of LIDAR_TOP with their boxes.

.. code-block:: text

    ROOT/
      v1.0-mini/ (or v1.0-trainval/, v1.0-test/)   scene.json sample.json sample_data.json sample_annotation.json ...
      samples/LIDAR_TOP/*.pcd.bin                  float32 x, y, z, intensity (0 to 255), ring
      sweeps/LIDAR_TOP/*.pcd.bin                   between key frames
      ImageSets/train.txt                          optional: scene names of a split, one per line

The sensor's x leads right and y forward; frames here have x forward and y left. Boxes of nuScenes stand in a global
frame with sizes w, l, h and quaternions w, x, y, z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.formats.binary import read_bin
from beambox.file_names import read_names
from beambox.io import read_json
from beambox.structures import Frame, Labels

__all__ = ["NuScenesSource", "nuscenes_tables"]

Floats = NDArray[np.float64]
VERSIONS = ("v1.0-trainval", "v1.0-mini", "v1.0-test")
SENSOR = "LIDAR_TOP"
TURN = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""From the sensor's axes (x right, y forward) to x forward, y left."""
OWN_VEHICLE = 1.0
"""Returns within this many metres of the sensor, ahead and aside, are from the vehicle's own roof."""


def nuscenes_tables(root: Path) -> Path | None:
    """Return the folder of the tables where a folder is nuScenes, or None."""
    return next((root / one for one in VERSIONS if (root / one / "sample.json").is_file()), None)


@dataclass(frozen=True)
class _Sweep:
    """One file of points."""

    path: str
    time: float
    to_global: Floats
    before: str


class NuScenesSource:
    """The key frames of some scenes."""

    def __init__(
        self, root: Path | str, split: str = "all", *, version: str | None = None, sweeps: int = 1, labels: bool = True
    ) -> None:
        """Read the tables; no points are read yet.

        Args:
            root: the folder that holds v1.0-*/ and samples/.
            split: "all", the name of a scene, or of a list ImageSets/SPLIT.txt of scene names.
            version: name of the folder of tables; the first there is of v1.0-trainval, v1.0-mini, v1.0-test where None.
            sweeps: how many sweeps make a frame: the key frame and those before it, carried into its LiDAR frame. More
                than one adds a fifth column, seconds before the key frame, and drops returns from the own vehicle.
            labels: read the boxes where there are any.

        Raises:
            MissingFileError: if a table is not there.
            BeamboxError: if a table lacks an entry, or there is no such split.
        """
        self.root = Path(root)
        self.sweeps = sweeps
        tables = nuscenes_tables(self.root) if version is None else self.root / version
        if tables is None:
            raise MissingFileError(f"{self.root} holds no tables of nuScenes; looked for {', '.join(VERSIONS)}")
        if sweeps < 1:
            raise BeamboxError(f"`sweeps` must be at least 1, got {sweeps}")
        try:
            self._read(tables, split, labels)
        except (KeyError, TypeError, AttributeError) as error:
            raise BeamboxError(f"{tables}: a table of nuScenes lacks an entry or refers to none: {error}") from None

    def _read(self, tables: Path, split: str, labels: bool) -> None:
        scenes = {one["name"]: one["token"] for one in _table(tables, "scene")}
        wanted = {scenes[name] for name in self._scenes(split, list(scenes))}
        samples = sorted(
            (one for one in _table(tables, "sample") if one["scene_token"] in wanted),
            key=lambda one: (one["scene_token"], one["timestamp"]),
        )
        lidars = {one["token"] for one in _table(tables, "sensor") if one["channel"] == SENSOR}
        mounted = {one["token"]: one for one in _table(tables, "calibrated_sensor") if one["sensor_token"] in lidars}
        egos = {one["token"]: one for one in _table(tables, "ego_pose")}
        self._data: dict[str, _Sweep] = {}
        keys: dict[str, str] = {}
        for one in _table(tables, "sample_data"):
            sensor = mounted.get(one["calibrated_sensor_token"])
            if sensor is None:
                continue
            motion = _pose(egos[one["ego_pose_token"]]) @ _pose(sensor) @ TURN.T
            self._data[one["token"]] = _Sweep(one["filename"], one["timestamp"] / 1e6, motion, one["prev"])
            if one["is_key_frame"]:
                keys[one["sample_token"]] = one["token"]
        self._frames = [(one["token"], keys[one["token"]]) for one in samples if one["token"] in keys]
        if not self._frames:
            raise BeamboxError(f"{tables} has no key frame of {SENSOR} in the split {split}")
        self._boxes: dict[str, list[tuple[str, dict[str, Any]]]] | None = None
        if labels and (tables / "sample_annotation.json").is_file():
            self._boxes = _annotations(tables, {token for token, _ in self._frames})

    def _scenes(self, split: str, names: list[str]) -> Sequence[str]:
        if split == "all":
            return names
        if split in names:
            return [split]
        listing = self.root / "ImageSets" / f"{split}.txt"
        if not listing.is_file():
            raise BeamboxError(
                f'{self.root} has no split "{split}": give all, the name of a scene, or write '
                f"scene names into {listing}"
            )
        listed = read_names(listing)
        for name in listed:
            if name not in names:
                raise BeamboxError(f'{listing}: there is no scene "{name}"{did_you_mean(name, names)}')
        return listed

    @property
    def ids(self) -> Sequence[str]:
        """Token of each key frame's sample."""
        return [token for token, _ in self._frames]

    def __len__(self) -> int:
        return len(self._frames)

    def pose(self, index: int) -> Floats:
        """Return ``(4, 4)`` from the LiDAR frame (x forward, y left) to the global one."""
        return self._data[self._frames[index][1]].to_global

    def __getitem__(self, index: int) -> Frame:
        """Read one key frame.

        Raises:
            MissingFileError: if a file of points is not there.
        """
        token, data = self._frames[index]
        key = self._data[data]
        to_lidar = np.linalg.inv(key.to_global).astype(np.float64)
        parts, following = [], data
        while following and len(parts) < self.sweeps:
            sweep = self._data[following]
            parts.append(self._points(sweep, to_lidar, key.time))
            following = sweep.before
        points = torch.from_numpy(np.concatenate(parts)).float()
        points = points if self.sweeps > 1 else points[:, :4]
        boxes = None if self._boxes is None else _labels(self._boxes.get(token, []), to_lidar)
        return Frame(points.contiguous(), token, labels=boxes)

    def _points(self, sweep: _Sweep, to_lidar: Floats, now: float) -> Floats:
        """Read a sweep in the key frame's LiDAR frame: ``(N, 5)`` x, y, z, intensity in [0, 1], age in seconds."""
        path = self.root / sweep.path
        if not path.resolve().is_relative_to(self.root.resolve()):
            raise BeamboxError(f"{sweep.path} in sample_data.json leads out of {self.root}")
        raw = read_bin(path, 5).astype(np.float64)
        raw = raw[np.isfinite(raw).all(axis=1)]
        if self.sweeps > 1:
            raw = raw[(np.abs(raw[:, :2]) >= OWN_VEHICLE).any(axis=1)]
        motion = to_lidar @ sweep.to_global @ TURN
        xyz = raw[:, :3] @ motion[:3, :3].T + motion[:3, 3]
        age = np.full((len(raw), 1), now - sweep.time)
        return np.concatenate((xyz, raw[:, 3:4] / 255, age), axis=1)


def _table(folder: Path, name: str) -> list[dict[str, Any]]:
    path = folder / f"{name}.json"
    rows = read_json(path, "it is one of the tables of nuScenes")
    if not isinstance(rows, list):
        raise BeamboxError(f"{path} must hold a list, got {type(rows).__name__}")
    return rows


def _annotations(tables: Path, wanted: set[str]) -> dict[str, list[tuple[str, dict[str, Any]]]]:
    categories = {one["token"]: one["name"] for one in _table(tables, "category")}
    names = {one["token"]: categories[one["category_token"]] for one in _table(tables, "instance")}
    found: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for one in _table(tables, "sample_annotation"):
        if one["sample_token"] in wanted:
            found.setdefault(one["sample_token"], []).append((names[one["instance_token"]], one))
    return found


def _pose(entry: dict[str, Any]) -> Floats:
    """Return ``(4, 4)`` of a table's translation and rotation (quaternion w, x, y, z)."""
    matrix = np.eye(4)
    matrix[:3, :3] = _rotation(entry["rotation"])
    matrix[:3, 3] = entry["translation"]
    return matrix


def _rotation(quaternion: Sequence[float]) -> Floats:
    values = np.array(quaternion, dtype=np.float64)
    length = float(np.linalg.norm(values))
    if values.shape != (4,) or not math.isfinite(length) or abs(length - 1) > 1e-2:
        raise BeamboxError(f"a rotation of nuScenes must be a quaternion of length 1, got {list(quaternion)}")
    w, x, y, z = values / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _labels(found: list[tuple[str, dict[str, Any]]], to_lidar: Floats) -> Labels:
    boxes = []
    for _, one in found:
        center = to_lidar[:3, :3] @ np.array(one["translation"], dtype=np.float64) + to_lidar[:3, 3]
        heading = to_lidar[:3, :3] @ _rotation(one["rotation"])[:, 0]
        width, length, height = one["size"]
        boxes.append([*center, length, width, height, math.atan2(heading[1], heading[0])])
    numbers = torch.tensor(boxes, dtype=torch.float64).reshape(-1, 7)
    return Labels(numbers, tuple(name for name, _ in found))
