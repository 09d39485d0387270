"""From a recipe's `data` and `augment` to frame sources and the function that changes a frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.kitti import KittiSource
from beambox.data.source import FrameSource, SubsetSource
from beambox.structures import Frame
from beambox.train.config import Recipe, SourceSection

__all__ = ["make_change", "open_source"]


def open_source(section: SourceSection, data: Path | None) -> FrameSource:
    """Open one source of a recipe.

    Args:
        section: what to open.
        data: folder that ``{data}`` stands for.

    Raises:
        BeamboxError: if the folder is needed and not given, or is not such a data set.
    """
    source = OPENERS[section.kind](section, data)
    if section.frames is None or section.frames >= len(source):
        return source
    spread = np.linspace(0, len(source) - 1, section.frames).round().astype(int)
    return SubsetSource(source, [int(i) for i in spread])


def folder_of(section: SourceSection, data: Path | None) -> Path:
    """Return the folder of a source."""
    if "{data}" in section.path and data is None:
        raise BeamboxError(f'the recipe reads its data from "{section.path}"; say where that is with --data DIR')
    return Path(section.path.replace("{data}", str(data)))


def open_kitti(section: SourceSection, data: Path | None) -> FrameSource:
    """Open a data set in KITTI's layout."""
    return KittiSource(folder_of(section, data), section.split, fov=section.camera_view)


OPENERS: dict[str, Callable[[SourceSection, Path | None], FrameSource]] = {
    "kitti": open_kitti,
}


def make_change(
    recipe: Recipe, sources: Sequence[FrameSource], folder: Path | None
) -> Callable[[Frame, np.random.Generator], Frame]:
    """Return the function that augments a training frame, as the recipe says."""
    return unchanged


def unchanged(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return the frame with its points in random order, so that full voxels keep a random choice of theirs."""
    return frame.with_points(frame.points[rng.permutation(len(frame))])
