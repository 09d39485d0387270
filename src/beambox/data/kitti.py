"""KITTI's folder layout, read and written; also what `beambox simulate` writes and any data set brought in that form.

.. code-block:: text

    ROOT/
      ImageSets/train.txt val.txt test.txt    one frame name a line; `beambox data splits ROOT` writes KITTI's
      training/  (testing/ for the split "test")
        velodyne/000000.bin                   float32 x, y, z, reflectance
        calib/000000.txt                      needed for labels and for the camera's view
        label_2/000000.txt                    optional
        image_2/000000.png                    optional; without it 1242 x 375 pixels are assumed
        planes/000000.txt                     optional road planes; without them augmentation fits its own
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import torch

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.kitti_calibration import (
    CALIBRATION_REMEDY,
    format_calibration,
    parse_calibration,
    read_calibration,
)
from beambox.data.kitti_text import (
    DONT_CARE,
    format_labels,
    parse_labels,
    parse_plane,
    parse_results,
    read_labels,
    read_results,
)
from beambox.data.read_points import read_frame
from beambox.file_names import check_file_name, read_names
from beambox.geometry import Calibration
from beambox.io import read_text, write_bytes, write_text
from beambox.structures import Frame, Labels

__all__ = [
    "DEFAULT_IMAGE_SIZE",
    "KittiSource",
    "format_calibration",
    "format_labels",
    "parse_calibration",
    "parse_labels",
    "parse_results",
    "png_size",
    "read_calibration",
    "read_labels",
    "read_results",
    "write_kitti_frame",
    "write_split",
]

DEFAULT_IMAGE_SIZE = (1242, 375)
TEST_SPLITS = ("test", "testing")
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


class KittiSource:
    """The frames of one split of a data set in KITTI's layout (drawn at the top of this module)."""

    def __init__(self, root: Path | str, split: str = "train", fov: bool = False, *, labels: bool = True) -> None:
        """Find the frames; nothing but the split's list is read yet.

        Args:
            root: the folder that holds training/ and ImageSets/ (or itself velodyne/).
            split: name of a list in ImageSets/; "test" reads the folder testing/, all others training/; "all" is every
                frame of training/. Without lists only "all" and "test" (every frame of testing/) are there.
            fov: keep only the points that the camera sees; KITTI labels only those. Where no label has an image box
                there was no camera, and all points are kept.
            labels: read label_2 where it is there.

        Raises:
            MissingFileError: if the folder or the split's list is not there.
            BeamboxError: if the split has no frame.
        """
        self.root = Path(root)
        self.split = split
        self.fov = fov
        self.with_labels = labels
        self.folder = _frame_folder(self.root, "testing" if split in TEST_SPLITS else "training")
        self._ids = _frame_names(self.root, self.folder, split)

    @property
    def ids(self) -> Sequence[str]:
        """Name of each frame, in the order of the split's list."""
        return self._ids

    def __len__(self) -> int:
        return len(self._ids)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            MissingFileError: if the sweep is not there, or the calibration where labels or the camera's view need it.
            BeamboxError: naming file and line, if one cannot be parsed.
        """
        name = self._ids[index]
        calibration = self._calibration_if_there(name)
        notes: tuple[str, ...] = ()
        camera = self.has_image_boxes or self._image_path(name) is not None
        if not camera:
            notes = ("all image boxes are 0 (labels made without a camera): no difficulty levels, no camera's view",)
        if calibration is None:
            self._refuse_without_calibration(name)
            notes += (f"no calib/{name}.txt: {CALIBRATION_REMEDY}",)
        sweep = self.path("velodyne", name)
        if not sweep.is_file():
            raise MissingFileError(f"{sweep} is not there, the sweep of frame {name}")
        read = read_frame(sweep)
        image_path = self._image_path(name)
        frame = Frame(
            points=read.points,
            id=name,
            labels=self._labels(name, calibration),
            calibration=calibration,
            image_path=image_path,
            image_size=self.image_size(index) if calibration is not None and camera else None,
            plane=self._plane(name, calibration),
            notes=notes + read.notes,
        )
        return frame.camera_view() if self.fov and camera else frame

    def path(self, kind: str, name: str) -> Path:
        """Path of one file: kind is velodyne, calib, label_2, image_2 or planes; it need not exist."""
        ending = {"velodyne": ".bin", "image_2": ".png"}.get(kind, ".txt")
        return self.folder / kind / (name + ending)

    def calibration(self, index: int) -> Calibration:
        """Read the calibration of a frame, and nothing else."""
        return read_calibration(self.path("calib", self._ids[index]))

    def labels(self, index: int) -> Labels | None:
        """Read the labels of a frame, and no points; None where there is no label file."""
        name = self._ids[index]
        path = self.path("label_2", name)
        return self._labels_of(path, self.calibration(index)) if path.exists() else None

    @cached_property
    def has_image_boxes(self) -> bool:
        """Whether any label has a box in the image.

        None has where there was no camera, and KITTI's levels are then unknown. Looks through label files until one
        tells; True where there are none.
        """
        present = None
        for name in self._ids:
            path = self.path("label_2", name)
            if path.exists():
                present = image_boxes_given(read_text(path), present)
                if present:
                    return True
        return present is not False

    def _labels_of(self, path: Path, calibration: Calibration) -> Labels:
        labels = read_labels(path, calibration)
        return labels if self.has_image_boxes else replace(labels, attributes=None)

    def image_size(self, index: int) -> tuple[int, int]:
        """(width, height) of a frame's image in pixels, from the PNG header; 1242 x 375 where there is none."""
        path = self._image_path(self._ids[index])
        return DEFAULT_IMAGE_SIZE if path is None else png_size(path)

    def _image_path(self, name: str) -> Path | None:
        path = self.path("image_2", name)
        return path if path.exists() else None

    def _calibration_if_there(self, name: str) -> Calibration | None:
        path = self.path("calib", name)
        return read_calibration(path) if path.exists() else None

    def _refuse_without_calibration(self, name: str) -> None:
        calib = self.path("calib", name)
        if self.fov:
            raise MissingFileError(f"{calib} is not there, and the camera's view (fov=True) needs it; use fov=False")
        if self.with_labels and self.path("label_2", name).exists():
            raise MissingFileError(
                f"{calib} is not there, and without it the boxes of {self.path('label_2', name)} cannot be placed "
                "among the points; give it, or read the points alone with labels=False"
            )

    def _labels(self, name: str, calibration: Calibration | None) -> Labels | None:
        path = self.path("label_2", name)
        if calibration is None or not self.with_labels or not path.exists():
            return None
        return self._labels_of(path, calibration)

    def _plane(self, name: str, calibration: Calibration | None) -> torch.Tensor | None:
        path = self.path("planes", name)
        if calibration is None or not path.exists():
            return None
        return parse_plane(read_text(path), calibration, str(path))


def image_boxes_given(text: str, present: bool | None = None) -> bool | None:
    """Tell whether a label file's objects have boxes in the image: None (or what was known) where it has no object."""
    for line in text.splitlines():
        words = line.split()
        if len(words) >= 8 and words[0].lower() != DONT_CARE.lower():
            present = False
            try:
                left, top, right, bottom = map(float, words[4:8])
            except ValueError:
                return True  # whoever reads the labels says what is wrong
            if right > left and bottom > top:
                return True
    return present


def _frame_folder(root: Path, part: str) -> Path:
    if (root / part / "velodyne").is_dir() or (root / part).is_dir():
        return root / part
    if (root / "velodyne").is_dir():
        return root
    if not root.is_dir():
        raise MissingFileError(f"{root} is not a folder; expected one that holds {part}/velodyne, {part}/calib, ...")
    inside = ", ".join(sorted(entry.name for entry in root.iterdir())[:8]) or "nothing"
    raise MissingFileError(f"{root} must hold {part}/velodyne (KITTI's layout), but holds {inside}")


def _frame_names(root: Path, folder: Path, split: str) -> list[str]:
    sets = next((place for place in (root / "ImageSets", folder.parent / "ImageSets") if place.is_dir()), None)
    listing = (sets or root / "ImageSets") / f"{check_file_name(split, 'the split')}.txt"
    if listing.exists():
        return read_names(listing)
    if split != "all" and split not in TEST_SPLITS:
        if sets is None:
            raise MissingFileError(
                f'{listing} is not there, so nobody knows which frames belong to "{split}"; `beambox data splits '
                f'{root}` writes KITTI\'s usual lists of 3712 and 3769 frames, and the split "all" is every frame'
            )
        known = [path.stem for path in sets.glob("*.txt")]
        raise MissingFileError(f'{listing} is not there: no split "{split}"{did_you_mean(split, [*known, "all"])}')
    names = sorted(path.stem for path in (folder / "velodyne").glob("*.bin"))
    if not names:
        raise BeamboxError(f"{folder / 'velodyne'} must hold sweeps (*.bin), but has none")
    return names


def png_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a PNG in pixels, reading its header only.

    Raises:
        BeamboxError: if the file is not a PNG.
    """
    with path.open("rb") as stream:
        head = stream.read(24)
    if len(head) < 24 or not head.startswith(PNG_MAGIC):
        raise BeamboxError(f"{path} must be a PNG image, but does not begin like one")
    width, height = struct.unpack(">II", head[16:24])
    return width, height


def write_kitti_frame(root: Path | str, frame: Frame, part: str = "training") -> None:
    """Write one frame's sweep, calibration and labels in KITTI's layout; images are not written.

    Args:
        root: folder that gets training/velodyne/ID.bin, training/calib/ID.txt, training/label_2/ID.txt.
        frame: must have an id; point columns beyond the fourth are dropped (the layout has four).
        part: "training" or "testing".

    Raises:
        BeamboxError: if the frame has no id, or labels but no calibration.
    """
    folder = Path(root) / part
    check_file_name(frame.id, "a frame to write")
    if frame.labels is not None and frame.calibration is None:
        raise BeamboxError(
            f"frame {frame.id} has labels but no calibration; KITTI's label files are in camera coordinates"
        )
    write_bytes(folder / "velodyne" / f"{frame.id}.bin", frame.points[:, :4].cpu().numpy().astype("<f4").tobytes())
    if frame.calibration is not None:
        write_text(folder / "calib" / f"{frame.id}.txt", format_calibration(frame.calibration))
        if frame.labels is not None:
            text = format_labels(frame.labels, frame.calibration, frame.image_size)
            write_text(folder / "label_2" / f"{frame.id}.txt", text)


def write_split(root: Path | str, split: str, names: Sequence[str]) -> None:
    """Write ImageSets/<split>.txt."""
    for name in (split, *names):
        check_file_name(name, "a split to write")
    write_text(Path(root) / "ImageSets" / f"{split}.txt", "".join(f"{name}\n" for name in names))
