"""A folder of your own, without a description: sweeps of any format, and boxes as text in the LiDAR's frame.

.. code-block:: text

    ROOT/
      points/NAME.bin  (.npy .npz .pcd .ply .las .laz)
      labels/NAME.txt          a line per object: class x y z l w h yaw  (metres, radians; # begins a comment);
                               x y z l w h yaw class, as OpenPCDet's custom data have it, is read as well
      ImageSets/train.txt      optional lists of names; where absent, every sweep

x, y, z is the box's geometric centre; yaw grows counter-clockwise in BEV, 0 along +x. Further columns of a
label line are ignored. Other layouts, axes and classes are described by a YAML file: :mod:`beambox.data.custom`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.box_files import box_words
from beambox.data.read_points import read_frame, readable_suffixes
from beambox.file_names import name_to_word, read_names
from beambox.io import read_text
from beambox.structures import Frame, Labels

__all__ = ["FolderSource", "format_boxes", "parse_boxes"]


class FolderSource:
    """The frames of a folder of one's own (drawn at the top of this module)."""

    def __init__(
        self,
        root: Path | str,
        split: str = "all",
        *,
        points: str = "points",
        labels: str = "labels",
        fields: str | Sequence[str] | None = None,
        intensity_scale: float | None = None,
    ) -> None:
        """Find the sweeps; nothing is read yet.

        Args:
            root: the folder.
            split: name of a list in ImageSets/; "all" is every sweep.
            points: name of the folder of sweeps.
            labels: name of the folder of labels; a sweep without a file there has no labels.
            fields: see :func:`beambox.data.read_points.read_frame`.
            intensity_scale: see :func:`beambox.data.read_points.read_frame`; give it where sweeps of one sensor are of
                different brightness, so that all are scaled alike.

        Raises:
            MissingFileError: if the folder, the list or a sweep of it is not there.
            BeamboxError: if there is no sweep, or two have one name.
        """
        self.root = Path(root)
        self.labels_folder = self.root / labels
        self.fields, self.intensity_scale = fields, intensity_scale
        folder, suffixes = self.root / points, readable_suffixes()
        if not folder.is_dir():
            raise MissingFileError(f"{folder} is not a folder; expected one of sweeps ({' '.join(suffixes)})")
        found: dict[str, Path] = {}
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() in suffixes:
                if path.stem in found:
                    raise BeamboxError(f"{folder} holds two sweeps called {path.stem}; names must differ")
                found[path.stem] = path
        if not found:
            raise BeamboxError(f"{folder} must hold sweeps ({' '.join(suffixes)}), but has none")
        names = list(found) if split == "all" else _names(self.root / "ImageSets", split)
        for name in names:
            if name not in found:
                raise MissingFileError(f'split "{split}" names {name}, but {folder} holds no such sweep')
        self._paths = [found[name] for name in names]

    @property
    def ids(self) -> Sequence[str]:
        """Name of each sweep."""
        return [path.stem for path in self._paths]

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame."""
        path = self._paths[index]
        frame = read_frame(path, fields=self.fields, intensity_scale=self.intensity_scale)
        text = self.labels_folder / f"{path.stem}.txt"
        return replace(frame, labels=parse_boxes(read_text(text), str(text)) if text.exists() else None)


def _names(sets: Path, split: str) -> list[str]:
    listing = sets / f"{split}.txt"
    if not listing.exists():
        known = [*(path.stem for path in sets.glob("*.txt")), "all"]
        raise MissingFileError(f'{listing} is not there: no split "{split}"{did_you_mean(split, known)}')
    return read_names(listing)


def parse_boxes(text: str, where: str = "labels") -> Labels:
    """Parse lines of ``class x y z l w h yaw``; empty lines and those that begin with # are passed over.

    Args:
        text: content of a label file.
        where: what to call it in messages.

    Raises:
        BeamboxError: naming the line, if it has too few columns or is not numeric.
    """
    names, rows = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        name, numbers = box_words(words, f"{where}, line {number}")
        try:
            values = [float(word) for word in numbers]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            raise BeamboxError(
                f"{where}, line {number}: expected a class and 7 numbers, got {' '.join(words[:8])[:60]!r}"
            )
        if min(values[3:6]) < 0:
            raise BeamboxError(f"{where}, line {number}: l, w and h must be at least 0, got {' '.join(numbers[3:6])}")
        names.append(name)
        rows.append(values)
    return Labels(torch.tensor(rows, dtype=torch.float32).reshape(-1, 7), tuple(names))


def format_boxes(labels: Labels) -> str:
    """Write lines of ``class x y z l w h yaw``; inverse of :func:`parse_boxes` to a tenth of a millimetre."""
    return "".join(
        " ".join([name_to_word(name), *(f"{value:.4f}" for value in box)]) + "\n"
        for name, box in zip(labels.names, labels.boxes.tolist())
    )
