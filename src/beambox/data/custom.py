"""A data set of one's own, described by one small YAML file; see docs/custom_data.md.

Frames come in the house's LiDAR frame: x forward, y left, z up, and the ground at -1.73 m where the sensor's height is
known. No camera is needed; there are no difficulty levels, and the metrics give one AP a class.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.box_files import (
    CAMERA_AT_THE_SENSOR,
    NamedBoxes,
    parse_box_file,
    parse_frames_file,
    parse_kitti_boxes,
)
from beambox.data.custom_config import CustomConfig, read_custom_config
from beambox.data.kitti_calibration import read_calibration
from beambox.data.names import NameList
from beambox.data.reading import read_frame
from beambox.data.road import fit_road_plane
from beambox.geometry.axes import Axes, turn_boxes
from beambox.geometry.boxes import wrap_angle
from beambox.io import read_text
from beambox.ops.points_in_boxes import points_in_boxes_mask
from beambox.structures import Frame, Labels

__all__ = ["CustomSource"]

NO_BOXES = NamedBoxes((), np.zeros((0, 7)), ())


class CustomSource:
    """The frames of one split of a data set described by a YAML file."""

    def __init__(self, config: Path | str, split: str = "all", *, whole: bool = False) -> None:
        """Read the description and find the frames; no sweep is read yet.

        Args:
            config: the YAML file.
            split: a name under ``splits``, or "all" for every sweep that is there.
            whole: keep what lies outside ``range`` and boxes with fewer than ``min_points`` points, to look at the data
                as it is.

        Raises:
            MissingFileError: if the file, a folder or a list is not there.
            BeamboxError: if the description is wrong or there is no frame.
        """
        self.path = Path(config)
        self.root = self.path.parent
        self.config = read_custom_config(self.path)
        self.whole = whole
        self.axes = Axes.parse(self.config.axes)
        self._ids = _frame_names(self.root, self.config, split, self.path)
        self._all_boxes = self._read_all_boxes()

    @property
    def ids(self) -> Sequence[str]:
        """Name of each frame."""
        return self._ids

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes wanted."""
        return tuple(self.config.classes)

    def __len__(self) -> int:
        return len(self._ids)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            MissingFileError: if its sweep is not there.
            BeamboxError: naming file and line, if something cannot be read or a class is not mapped.
        """
        name = self._ids[index]
        path = self.root / _fill(self.config.points, name)
        if not path.is_file():
            raise MissingFileError(f"{path} is not there, the sweep of frame {name}")
        frame = read_frame(path, fields=self.config.fields, intensity_scale=self.config.intensity_scale)
        points = frame.points.clone()
        points[:, :3] = points[:, :3] @ self.axes.matrix.T.to(points)
        points[:, 2] += self.config.shift(points)
        labels = self.labels(index)
        if not self.whole:
            points, labels = self._crop(points, labels)
        return replace(frame, points=points, id=name, labels=labels, plane=fit_road_plane(points))

    def labels(self, index: int) -> Labels | None:
        """Read the boxes of a frame, and no points; None where the frame has no label file."""
        found = self._boxes(self._ids[index])
        if found is None:
            return None
        boxes = turn_boxes(torch.from_numpy(found.boxes), self.axes.matrix)
        boxes[:, 2] += self.config.shift(boxes)
        boxes[:, 6] = wrap_angle(boxes[:, 6])
        names = [self.config.class_of(name, place) for name, place in zip(found.names, found.places)]
        keep = [k for k, name in enumerate(names) if name is not None]
        return Labels(boxes[keep], tuple(name for name in names if name is not None))

    def _boxes(self, name: str) -> NamedBoxes | None:
        pattern, kind = self.config.labels, self.config.label_format
        if pattern is None or kind is None:
            return None
        if self._all_boxes is not None:  # in a table, a frame without a row has no objects
            return self._all_boxes.get(name, None if kind == "once" else NO_BOXES)
        path = self.root / _fill(pattern, name)
        if not path.is_file():
            return None
        if kind == "kitti":
            calibration = CAMERA_AT_THE_SENSOR
            if self.config.calibration is not None:
                calibration = read_calibration(self.root / _fill(self.config.calibration, name))
            return parse_kitti_boxes(read_text(path), calibration, str(path))
        if kind == "once":
            return parse_frames_file(read_text(path), kind, str(path)).get(name)
        return parse_box_file(read_text(path), kind, str(path))

    def _read_all_boxes(self) -> dict[str, NamedBoxes] | None:
        """Read the one file of all frames' boxes, where there is such a file."""
        pattern, kind = self.config.labels, self.config.label_format
        if pattern is None or kind is None or "{frame}" in pattern:
            return None
        return parse_frames_file(read_text(self.root / pattern), kind, str(self.root / pattern))

    def _crop(self, points: Tensor, labels: Labels | None) -> tuple[Tensor, Labels | None]:
        if self.config.range is not None:
            points = points[_inside(points, self.config.range)]
            labels = None if labels is None else labels[_inside(labels.boxes, self.config.range)]
        if self.config.min_points and labels is not None and len(labels):
            counts = points_in_boxes_mask(points[:, :3], labels.boxes).sum(dim=1)  # (M,)
            labels = labels[counts >= self.config.min_points]
        return points, labels


def _fill(pattern: str, name: str) -> str:
    return pattern.replace("{frame}", name)


def _inside(rows: Tensor, limits: tuple[float, float, float, float]) -> Tensor:
    x, y = rows[:, 0], rows[:, 1]
    return (x >= limits[0]) & (x < limits[2]) & (y >= limits[1]) & (y < limits[3])


def _frame_names(root: Path, config: CustomConfig, split: str, where: Path) -> NameList:
    if split in config.splits:
        listing = root / config.splits[split]
        names = NameList(read_text(listing, f"the list of the split {split}").split())
        if not len(names):
            raise BeamboxError(f"{listing} must name the frames of the split {split}, one a line, but is empty")
        repeated = names.first_repeated()
        if repeated is not None:
            raise BeamboxError(f"{listing} must name each frame once, but names {repeated} again")
        return names
    if split != "all":
        raise BeamboxError(f'{where} has no split "{split}"{did_you_mean(split, [*config.splits, "all"])}')
    pattern = Path(config.points)
    folder, (begin, end) = root / pattern.parent, pattern.name.split("{frame}", 1)
    if "{frame}" in str(pattern.parent):
        raise BeamboxError(f"{where}: to find all frames, {{frame}} must stand in the file's name; or give `splits`")
    if not folder.is_dir():
        raise MissingFileError(f"{folder}, the folder of the sweeps, is not there")
    with os.scandir(folder) as entries:
        files = (entry.name for entry in entries)
        found = sorted(
            file[len(begin) : len(file) - len(end)]
            for file in files
            if file.startswith(begin) and file.endswith(end) and len(file) > len(begin) + len(end)
        )
    if not found:
        raise BeamboxError(f"{folder} holds no sweep {_fill(pattern.name, '*')}")
    return NameList(found)
