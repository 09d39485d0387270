"""From a recipe's `data` and `augment` to frame sources and the function that changes a frame."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.augment import augment, shuffle_points
from beambox.data.custom import CustomSource
from beambox.data.database import ObjectDatabase
from beambox.data.kitti import KittiSource
from beambox.data.once import OnceSource
from beambox.data.source import FrameSource, SubsetSource
from beambox.structures import Frame
from beambox.train.config import AugmentSection, Recipe, SourceSection

__all__ = ["Augment", "open_database", "open_source", "shared_database"]


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


def open_once(section: SourceSection, data: Path | None) -> FrameSource:
    """Open a data set in ONCE's layout; its labels surround the sensor, so ``camera_view`` does nothing."""
    return OnceSource(folder_of(section, data), section.split)


def open_custom(section: SourceSection, data: Path | None) -> FrameSource:
    """Open a data set described by a YAML file; its frames have no camera either."""
    return CustomSource(folder_of(section, data), section.split)


def open_simulated(section: SourceSection, data: Path | None) -> FrameSource:
    """Make sweeps on the fly; slow for training on, handy for trying a recipe without any data."""
    from beambox.simulate import SimulatedSource

    if section.frames is None:
        raise BeamboxError("a simulated source has no end: say how many `frames` it has")
    return SimulatedSource(
        section.frames,
        section.seed,
        section.sensor,
        "camera" if section.camera_view else "full",
        section.layout.replace("{data}", str(data)),
    )


OPENERS: dict[str, Callable[[SourceSection, Path | None], FrameSource]] = {
    "kitti": open_kitti,
    "once": open_once,
    "custom": open_custom,
    "simulated": open_simulated,
}


def object_sources(recipe: Recipe, data: Path | None) -> list[tuple[SourceSection, FrameSource]]:
    """Open the sources whose objects are sampled, with whole sweeps.

    An object cut by the image's border is complete in the LiDAR's view.
    """
    sections = [section for section in recipe.data if section.objects]
    return [(section, open_source(section.model_copy(update={"camera_view": False}), data)) for section in sections]


def shared_database(recipe: Recipe, data: Path | None, folder: Path) -> Path | None:
    """Name the object database that every run with these objects can use; None where the recipe samples none.

    The name holds a digest of all that the objects depend on: sources and their frames, classes, and points asked for.

    Args:
        recipe: of one of the runs.
        data: folder that ``{data}`` stands for.
        folder: where such databases lie.
    """
    if recipe.augment is None or not recipe.augment.sample:
        return None
    sources = [
        [section.model_dump(mode="json", exclude={"weight", "camera_view"}), list(source.ids)]
        for section, source in object_sources(recipe, data)
    ]
    where = None if data is None else str(data.resolve())
    identity = [where, sources, list(recipe.augment.sample), recipe.augment.object_min_points]
    return folder / f"objects-{hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:12]}.npz"


def open_database(recipe: Recipe, data: Path | None, file: Path, reuse: bool, log: Callable[[str], None]) -> None:
    """Cut the objects for sampling out of the recipe's sources into ``file``.

    Args:
        recipe: with ``augment.sample``.
        data: folder that ``{data}`` stands for.
        file: where the database goes.
        reuse: take a file that is there already, as when a run is resumed.
        log: told what happens.
    """
    assert recipe.augment is not None
    if reuse and file.exists():
        return
    parts = []
    for section, source in object_sources(recipe, data):
        where = "the simulator" if section.kind == "simulated" else f"{folder_of(section, data)} {section.split}"
        log(f"cutting objects out of the {len(source)} frames of {where}")
        parts.append(ObjectDatabase.build(source, tuple(recipe.augment.sample), recipe.augment.object_min_points))
    if not parts:
        raise BeamboxError("augment.sample needs objects: let at least one source of `data` have `objects: true`")
    database = ObjectDatabase.joined(parts)
    log(f"object database: {', '.join(f'{count} {name}' for name, count in database.counts().items())}")
    database.save(file)


class Augment:
    """Augments the frame at a position of the run; a pure function of frame, position and random generator."""

    def __init__(self, section: AugmentSection | None, database: ObjectDatabase | None, seed: int) -> None:
        self.section, self.database, self.seed = section, database, seed

    def __call__(self, frame: Frame, rng: np.random.Generator, position: int) -> Frame:
        """Return the augmented frame."""
        if self.section is None:
            return shuffle_points(frame, rng)
        return augment(frame, rng, self.section, self.database, position, self.seed)
