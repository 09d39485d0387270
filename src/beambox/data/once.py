"""ONCE's folder layout (ONCE devkit).

.. code-block:: text

    ROOT/
      ImageSets/train.txt val.txt test.txt ...     one sequence a line
      data/000076/000076.json                      frames, and annotations of some of them
      data/000076/lidar_roof/1616343527200.bin     float32 x, y, z, intensity

Axes are ONCE's own (x left, y backward, z up), in points and boxes alike; nothing is turned. Intensity is not scaled
unless asked for, as the published detectors were trained on it as it is.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.files import read_text
from beambox.data.reading import read_frame
from beambox.structures import Frame, Labels

__all__ = ["OnceSource", "parse_sequence"]


@dataclass(frozen=True)
class _Entry:
    name: str
    path: Path
    labels: Labels | None


class OnceSource:
    """The frames of one split of ONCE; frames without annotation, or with none in it, are left out where labelled."""

    def __init__(
        self, root: Path | str, split: str = "train", *, labelled: bool = True, intensity_scale: float = 1.0
    ) -> None:
        """Read the sequences' lists of frames; no points yet.

        Args:
            root: the folder that holds data/ and ImageSets/.
            split: name of a list of sequences in ImageSets/.
            labelled: leave out frames without objects, as the devkit's tools do; False keeps every frame.
            intensity_scale: factor for intensity.

        Raises:
            MissingFileError: if a folder or list is not there.
            BeamboxError: if a sequence's file cannot be used, or no frame is left.
        """
        self.root = Path(root)
        sets = self.root / "ImageSets"
        listing = sets / f"{split}.txt"
        if not listing.exists():
            known = [path.stem for path in sets.glob("*.txt")]
            hint = did_you_mean(split, known) or " (expected ROOT/ImageSets and ROOT/data, ONCE's layout)"
            raise MissingFileError(f'{listing} is not there: no split "{split}"{hint}')
        self.intensity_scale = intensity_scale
        self._entries: list[_Entry] = []
        for sequence in read_text(listing).split():
            folder = self.root / "data" / sequence
            path = folder / f"{sequence}.json"
            for name, labels in parse_sequence(read_text(path, "it lists the frames of a sequence"), str(path)):
                if not labelled or (labels is not None and len(labels)):
                    self._entries.append(_Entry(name, folder / "lidar_roof" / f"{name}.bin", labels))
        if not self._entries:
            raise BeamboxError(f"{listing}: its sequences have no {'annotated ' if labelled else ''}frame")

    @property
    def ids(self) -> Sequence[str]:
        """ONCE's frame_id of each frame."""
        return [entry.name for entry in self._entries]

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame."""
        entry = self._entries[index]
        return replace(read_frame(entry.path, intensity_scale=self.intensity_scale), labels=entry.labels)


def parse_sequence(text: str, where: str = "sequence") -> list[tuple[str, Labels | None]]:
    """Parse a sequence's JSON: the name of each frame, and its labels where it is annotated.

    Args:
        text: content of the file.
        where: what to call it in messages.
    """
    try:
        frames = json.loads(text)["frames"]
        return [(str(frame["frame_id"]), _labels(frame.get("annos"))) for frame in frames]
    except json.JSONDecodeError as error:
        raise BeamboxError(f"{where}, line {error.lineno}: not valid JSON ({error.msg})") from None
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise BeamboxError(
            f"{where}: expected `frames`, each with `frame_id` and perhaps `annos` of `names` and `boxes_3d`; "
            f"got {type(error).__name__}: {error}"
        ) from None


def _labels(annotation: dict[str, list] | None) -> Labels | None:
    if annotation is None:
        return None
    boxes = torch.tensor(annotation["boxes_3d"], dtype=torch.float32).reshape(-1, 7)
    return Labels(boxes, tuple(str(name) for name in annotation["names"]))
