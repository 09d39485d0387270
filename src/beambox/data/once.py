"""The layout of the ONCE data set, read and written.

.. code-block:: text

    ROOT/
      ImageSets/train.txt val.txt test.txt ...   one sequence name a line; where absent, every sequence of data/
      data/000000/                               a sequence
        000000.json                              {"meta_info", "calib", "frames": [{"frame_id", "pose",
                                                  "annos": {"names", "boxes_3d", "boxes_2d"}}]}
        lidar_roof/1616343528200.bin             float32 x, y, z, intensity

Points and boxes keep ONCE's own axes (x left, y backward, z up). Most frames have no ``annos``: nobody labelled them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.names import NameList
from beambox.data.read_points import read_frame
from beambox.file_names import check_file_name, read_names
from beambox.io import read_json, write_bytes, write_text
from beambox.structures import Frame, Labels

__all__ = ["ONCE_CLASSES", "OnceSource", "write_once_sequence", "write_once_split"]

ONCE_CLASSES = ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")
"""Classes of the labels; car, bus and truck are merged by the metric, not here."""


@dataclass(frozen=True)
class _Sequence:
    """What is kept of one sequence's file; F frames, N boxes in all of them."""

    names: NameList  # F
    labeled: NDArray[np.bool_]  # (F,)
    counts: NDArray[np.int64]  # (F,) boxes
    boxes: NDArray[np.float32]  # (N, 7)
    classes: NDArray[np.int16]  # (N,) position in the source's class names

    def only(self, keep: NDArray[np.bool_]) -> _Sequence:
        """Leave frames out."""
        rows = np.repeat(keep, self.counts)
        names = NameList([name for name, kept in zip(self.names, keep) if kept])
        return _Sequence(names, self.labeled[keep], self.counts[keep], self.boxes[rows], self.classes[rows])


class OnceSource:
    """The frames of one split of a data set in ONCE's layout (drawn at the top of this module).

    Labels of all frames are held as arrays, points are read when asked for.
    """

    def __init__(
        self,
        root: Path | str,
        split: str = "train",
        *,
        mapping: Mapping[str, str | None] | None = None,
        labeled: bool = True,
        keep_empty: bool = False,
        intensity_scale: float | None = None,
    ) -> None:
        """Read the JSON files of a split's sequences.

        Args:
            root: the folder that holds ImageSets/ and data/.
            split: name of a list in ImageSets/; "all" is every sequence of data/.
            mapping: class in the files -> class wanted, None to leave it out; without it ONCE's five classes.
            labeled: leave out frames without a box, as the public toolbox does, in val too; False keeps every frame.
            keep_empty: of the labelled frames, keep those without a box as well.
            intensity_scale: factor for intensity, found from the numbers where None, as on every path; the public
                toolbox takes it as it is (1.0).

        Raises:
            MissingFileError: if the folder, the split's list or a sequence's file is not there.
            BeamboxError: naming file and key, if a file cannot be used; if no frame is left.
        """
        self.root = Path(root)
        self.split = split
        self.intensity_scale = intensity_scale
        self.mapping = {name: name for name in ONCE_CLASSES} if mapping is None else dict(mapping)
        self.classes = tuple(dict.fromkeys(name for name in self.mapping.values() if name is not None))
        self.sequences = _sequence_names(self.root, split)
        parts = [self._select(name, labeled, keep_empty) for name in self.sequences]
        self._labeled = np.concatenate([part.labeled for part in parts])
        self._sequence = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part.names) for part in parts])
        self._start = np.concatenate(([0], np.cumsum(np.concatenate([part.counts for part in parts]))))
        self._boxes = np.concatenate([part.boxes for part in parts])
        self._classes = np.concatenate([part.classes for part in parts])
        self._files = NameList.join([part.names for part in parts])
        self._ids = self._files if self._files.first_repeated() is None else self._qualified()
        if not len(self._files):
            what = "labelled frames with boxes" if labeled else "frames"
            raise BeamboxError(
                f'the split "{split}" of {self.root} has no {what}; for sweeps nobody labelled pass labelled=False'
            )

    @property
    def ids(self) -> Sequence[str]:
        """Name of each frame: its frame_id, behind the sequence's name where sequences repeat one."""
        return self._ids

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            MissingFileError: if its sweep is not there.
            BeamboxError: if the sweep cannot be read.
        """
        path = self.path(index)
        if not path.is_file():
            listing = self._json(self.sequences[self._sequence[index]])
            raise MissingFileError(f"{path} is not there, though {listing} lists the frame {self._files[index]}")
        frame = read_frame(path, intensity_scale=self.intensity_scale)
        return replace(frame, id=self._ids[index], labels=self.labels(index))

    def path(self, index: int) -> Path:
        """Path of a frame's sweep."""
        sequence = self.sequences[self._sequence[index]]
        return self.root / "data" / sequence / "lidar_roof" / f"{self._files[index]}.bin"

    def labels(self, index: int) -> Labels | None:
        """Labels of a frame, in ONCE's axes; None where nobody labelled it. Reads nothing."""
        if not self._labeled[index]:
            return None
        index = index % len(self)
        rows = slice(self._start[index], self._start[index + 1])
        names = tuple(self.classes[k] for k in self._classes[rows])
        return Labels(torch.from_numpy(self._boxes[rows].copy()), names)

    def _json(self, sequence: str) -> Path:
        return self.root / "data" / sequence / f"{sequence}.json"

    def _select(self, name: str, labeled: bool, keep_empty: bool) -> _Sequence:
        part = _read_sequence(self._json(name), self.mapping, self.classes)
        if not labeled:
            return part
        return part.only(part.labeled & (keep_empty | (part.counts > 0)))

    def _qualified(self) -> NameList:
        return NameList(f"{self.sequences[s]}_{name}" for s, name in zip(self._sequence, self._files))


def _sequence_names(root: Path, split: str) -> list[str]:
    folder = root / "data"
    if not folder.is_dir():
        raise MissingFileError(f"{root} must hold the folder data/ (ONCE's layout), and it is not there")
    listing = root / "ImageSets" / f"{check_file_name(split, 'the split')}.txt"
    if listing.is_file():
        names = read_names(listing)
    elif split == "all":
        names = sorted(path.name for path in folder.iterdir() if path.is_dir())
    else:
        known = [path.stem for path in (root / "ImageSets").glob("*.txt")]
        raise MissingFileError(f'{listing} is not there: no split "{split}"{did_you_mean(split, [*known, "all"])}')
    if not names:
        raise BeamboxError(f"{listing if listing.is_file() else folder} names no sequence")
    return names


def _read_sequence(path: Path, mapping: Mapping[str, str | None], classes: Sequence[str]) -> _Sequence:
    """Read a sequence's JSON and keep only names, boxes and classes."""
    content = read_json(path, "every sequence of data/ has a file of its own name")
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list):
        raise BeamboxError(f"{path}: expected a list under the key `frames`, got {type(frames).__name__}")
    place = {name: k for k, name in enumerate(classes)}
    names, labeled, counts, boxes, codes = [], [], [], [], []
    for number, frame in enumerate(frames):
        where = f"{path}, frames[{number}]"
        if not isinstance(frame, dict) or "frame_id" not in frame:
            raise BeamboxError(f"{where}: the key `frame_id` is missing")
        named = frame["frame_id"]
        names.append(check_file_name(str(named) if isinstance(named, int) else named, where))
        annotations = frame.get("annos")
        labeled.append(annotations is not None)
        if annotations is None:
            counts.append(0)
            continue
        rows, words = _annotations(annotations, where)
        wanted = [_mapped(word, mapping, f"{where}.annos.names[{k}]") for k, word in enumerate(words)]
        kept = [k for k, name in enumerate(wanted) if name is not None]
        counts.append(len(kept))
        boxes.append(rows[kept])
        codes += [place[name] for name in wanted if name is not None]
    return _Sequence(
        NameList(names),
        np.array(labeled, dtype=np.bool_),
        np.array(counts, dtype=np.int64),
        np.concatenate([np.zeros((0, 7), dtype=np.float32), *boxes]),
        np.array(codes, dtype=np.int16),
    )


def _annotations(annotations: Any, where: str) -> tuple[NDArray[np.float32], list[str]]:
    for key in ("names", "boxes_3d"):
        if not isinstance(annotations, dict) or not isinstance(annotations.get(key), list):
            raise BeamboxError(f"{where}.annos: expected a list under the key `{key}`")
    words = [str(name) for name in annotations["names"]]
    try:
        with np.errstate(over="ignore"):
            rows = np.array(annotations["boxes_3d"], dtype=np.float32)
        rows = rows.reshape(0, 7) if rows.size == 0 else rows
        if rows.ndim != 2 or rows.shape[1] != 7:
            raise ValueError(rows.shape)
    except (TypeError, ValueError, OverflowError):
        raise BeamboxError(f"{where}.annos.boxes_3d: expected rows of 7 numbers x y z l w h yaw") from None
    if len(rows) != len(words):
        raise BeamboxError(f"{where}.annos: {len(words)} names but {len(rows)} boxes_3d")
    if not np.isfinite(rows).all() or (rows[:, 3:6] < 0).any():
        raise BeamboxError(f"{where}.annos.boxes_3d: expected finite numbers and sizes of at least 0")
    return rows, words


def _mapped(word: str, mapping: Mapping[str, str | None], where: str) -> str | None:
    if word not in mapping:
        raise BeamboxError(f'{where}: no mapping names the class "{word}"{did_you_mean(word, mapping)}')
    return mapping[word]


def write_once_sequence(
    root: Path | str, sequence: str, frames: Iterable[Frame], cameras: Mapping[str, Any] | None = None
) -> int:
    """Write frames as one sequence, the JSON file last; points and boxes keep their axes.

    Args:
        root: folder that gets ``data/SEQUENCE``.
        sequence: name of the sequence.
        frames: each with an id; frames without labels get no ``annos``. They are taken one at a time.
        cameras: name -> ``{"cam_to_velo", "cam_intrinsic", "distortion"}``, the file's ``calib``. Every box gets the
            2-D box -1 -1 -1 -1 in each of them, ONCE's sign for an object that the camera does not show.

    Returns:
        How many frames were written.

    Raises:
        BeamboxError: if a frame has no id that can name a file, or repeats one.
    """
    folder = Path(root) / "data" / check_file_name(sequence, "a sequence to write")
    entries: dict[str, dict[str, Any]] = {}
    for frame in frames:
        check_file_name(frame.id, "a frame to write")
        if frame.id in entries:
            raise BeamboxError(f"each frame needs an id of its own, got {frame.id} again")
        points = frame.points[:, :4].cpu().numpy().astype("<f4")
        write_bytes(folder / "lidar_roof" / f"{frame.id}.bin", points.tobytes())
        entry: dict[str, Any] = {"sequence_id": sequence, "frame_id": frame.id, "pose": [0, 0, 0, 1, 0, 0, 0]}
        if frame.labels is not None:
            boxes = frame.labels.boxes.double().tolist()
            unseen = {name: [[-1.0] * 4] * len(boxes) for name in cameras or {}}
            entry["annos"] = {"names": list(frame.labels.names), "boxes_3d": boxes, "boxes_2d": unseen}
        entries[frame.id] = entry
    content = {"meta_info": {}, "calib": dict(cameras or {}), "frames": list(entries.values())}
    write_text(folder / f"{sequence}.json", json.dumps(content) + "\n")
    return len(entries)


def write_once_split(root: Path | str, split: str, sequences: Sequence[str]) -> None:
    """Write the list of a split's sequences."""
    for name in (split, *sequences):
        check_file_name(name, "a split to write")
    write_text(Path(root) / "ImageSets" / f"{split}.txt", "".join(f"{name}\n" for name in sequences))
