"""A data set of one's own, described by one small YAML file; see docs/custom_data.md.

Frames come in the house's LiDAR frame: x forward, y left, z up, and the ground at -1.73 m where the sensor's height is
known. No camera is needed; there are no difficulty levels, and the metrics give one AP per class.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
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
from beambox.data.ground_plane import fit_ground_plane
from beambox.data.kitti_calibration import read_calibration
from beambox.data.names import NameList
from beambox.data.read_points import read_shifted
from beambox.file_names import read_names
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
        self._refuse_labels_of_other_frames()

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
        frame, shift = read_shifted(path, fields=self.config.fields, intensity_scale=self.config.intensity_scale)
        points = frame.points.clone()
        points[:, :3] = points[:, :3] @ self.axes.matrix.T.to(points)
        points[:, 2] += self.config.shift(points)
        labels = self._placed(self._boxes(name), shift)
        if not self.whole:
            points, labels = self._crop(points, labels)
        return replace(frame, points=points, id=name, labels=labels, plane=fit_ground_plane(points))

    def labels(self, index: int) -> Labels | None:
        """Read the boxes of a frame, and no points; None where the frame has no label file."""
        return self._placed(self._boxes(self._ids[index]), (0.0, 0.0))

    def _placed(self, found: NamedBoxes | None, shift: tuple[float, float]) -> Labels | None:
        """Turn a file's boxes into the house's frame; ``shift`` was taken from x and y of the points."""
        if found is None:
            return None
        given = torch.from_numpy(found.boxes).clone()
        given[:, :2] -= torch.tensor(shift, dtype=given.dtype)
        boxes = turn_boxes(given, self.axes.matrix)
        boxes[:, 2] += self.config.shift(boxes)
        if not self.whole:  # a check of the data must see degrees as they are written
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

    def _refuse_labels_of_other_frames(self) -> None:
        """Refuse labels that name no sweep: nothing would be trained on, without a word.

        A table may hold frames whose sweeps are elsewhere; it is refused where no frame of it has a sweep, or where a
        frame is called nearly as a sweep (Excel writes 123 for 000123).
        """
        if self.config.labels is None:
            return
        sweeps = set(_fitting(self.root, self.config.points)) | set(self._ids)
        where = self.root / self.config.labels
        if self._all_boxes is None:
            files = _fitting(self.root, self.config.labels)
            if files and not sweeps & set(files):
                hint = _near(files[0], sweeps)
                raise BeamboxError(f"{where}: none of the {len(files)} label files is called as a sweep{hint}")
            return
        strange = [name for name in self._all_boxes if name not in sweeps]
        alike = {_bare(name): name for name in sweeps}
        for name in strange:
            if _bare(name) in alike:
                raise BeamboxError(f'frame "{name}" of {where} is no sweep; is it {alike[_bare(name)]}?')
        if strange and len(strange) == len(self._all_boxes):
            hint = _near(strange[0], sweeps)
            raise BeamboxError(f"{where}: none of its {len(strange)} frames is a sweep{hint}")

    def _crop(self, points: Tensor, labels: Labels | None) -> tuple[Tensor, Labels | None]:
        if self.config.range is not None:
            points = points[_inside(points, self.config.range)]
            labels = None if labels is None else labels[_inside(labels.boxes, self.config.range)]
        if self.config.min_points and labels is not None and len(labels):
            counts = points_in_boxes_mask(points[:, :3], labels.boxes).sum(dim=1)  # (M,)
            labels = labels[counts >= self.config.min_points]
        return points, labels


def _bare(name: str) -> str:
    """Return a frame's name without what tools drop or add: zeros in front, folders, an ending."""
    return name.replace("\\", "/").rsplit("/", 1)[-1].split(".")[0].lstrip("0").lower()


def _near(name: str, sweeps: Collection[str]) -> str:
    return (
        f': "{name}", but sweeps are called {", ".join(sorted(sweeps)[:2])}{did_you_mean(name, list(sweeps)[:10_000])}'
    )


def _fill(pattern: str, name: str) -> str:
    return pattern.replace("{frame}", name)


def _inside(rows: Tensor, limits: tuple[float, float, float, float]) -> Tensor:
    x, y = rows[:, 0], rows[:, 1]
    return (x >= limits[0]) & (x < limits[2]) & (y >= limits[1]) & (y < limits[3])


def _frame_names(root: Path, config: CustomConfig, split: str, where: Path) -> NameList:
    if split in config.splits:
        listing = root / config.splits[split]
        return NameList(read_names(listing, f"the list of the split {split}"))
    if split != "all":
        raise BeamboxError(f'{where} has no split "{split}"{did_you_mean(split, [*config.splits, "all"])}')
    pattern = Path(config.points)
    if pattern.name.count("{frame}") != 1 or "{frame}" in str(pattern.parent):
        raise BeamboxError(
            f"{where}: to find all frames, {{frame}} must stand once in the file's name of `points`, and in none of "
            f"its folders, got {config.points}; or list them under `splits`"
        )
    if not (root / pattern.parent).is_dir():
        raise MissingFileError(f"{root / pattern.parent}, the folder of the sweeps, is not there")
    found = _fitting(root, config.points)
    if not found:
        raise BeamboxError(f"{root / pattern.parent} holds no sweep {_fill(pattern.name, '*')}")
    return NameList(found)


def _fitting(root: Path, path: str) -> list[str]:
    """Return the names that stand for {frame} in the files there are; none where it stands in a folder's name."""
    pattern = Path(path)
    folder = root / pattern.parent
    if pattern.name.count("{frame}") != 1 or "{frame}" in str(pattern.parent) or not folder.is_dir():
        return []
    begin, end = pattern.name.split("{frame}")
    with os.scandir(folder) as entries:
        files = (entry.name for entry in entries)
        return sorted(
            file[len(begin) : len(file) - len(end)]
            for file in files
            if file.startswith(begin) and file.endswith(end) and len(file) > len(begin) + len(end)
        )
