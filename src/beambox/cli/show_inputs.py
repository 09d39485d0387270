"""What `beambox show` draws: sweeps that lie in files, or the frames of a data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beambox.checks import BeamboxError, did_you_mean

if TYPE_CHECKING:
    from beambox.data.source import FrameSource
    from beambox.infer.predictor import Detector
    from beambox.structures import Frame

__all__ = ["Shown", "data_set_of", "detector_for", "sweeps_of"]


@dataclass(frozen=True)
class Shown:
    """A sweep to draw, read when it is its turn."""

    name: str
    read: Callable[[], Frame]


def data_set_of(inputs: Sequence[str], split: str) -> FrameSource | None:
    """Open the data set that is named: a YAML file, or a folder in ONCE's layout or with points/; None for sweeps.

    A folder in KITTI's layout is read sweep by sweep, whatever of it is there.

    Raises:
        BeamboxError: if a data set stands among other inputs.
    """
    from beambox.data.custom import CustomSource
    from beambox.data.open_dataset import open_dataset

    described = [path for path in map(Path, inputs) if path.suffix.lower() in (".yaml", ".yml")]
    folders = [path for path in map(Path, inputs) if _own_layout(path)]
    if not described and not folders:
        return None
    if len(inputs) > 1:
        raise BeamboxError(f"a data set is shown by itself, but {(described or folders)[0]} stands among other inputs")
    if described:
        return CustomSource(described[0], split or "all", whole=True)
    return open_dataset(folders[0], split or "all")


def _own_layout(path: Path) -> bool:
    if not path.is_dir() or (path / "training").is_dir() or (path / "velodyne").is_dir():
        return False
    return (path / "points").is_dir() or ((path / "data").is_dir() and (path / "ImageSets").is_dir())


def of_data_set(source: FrameSource, names: str, most: int) -> list[Shown]:
    """List frames of a data set.

    Args:
        source: of frames.
        names: frames to take, as 000001,000002; all where empty.
        most: the first so many; 0: all.

    Raises:
        BeamboxError: if the data set has no frame of a name.
    """
    known = list(source.ids)
    wanted = [name.strip() for name in names.split(",") if name.strip()] or known
    place = {name: k for k, name in enumerate(known)}
    for name in wanted:
        if name not in place:
            raise BeamboxError(f'the data set has no frame "{name}"{did_you_mean(name, known)}')
    return [Shown(name, partial(source.__getitem__, place[name])) for name in wanted[: most or None]]


def of_files(
    inputs: Sequence[str], names: str, most: int, fields: str | None, intensity_scale: float | None, labels: bool
) -> list[Shown]:
    """List sweeps that files, folders, patterns and recordings name; see :func:`of_data_set` for the rest."""
    from beambox.infer.inputs import find_sweeps, read_sweep

    sweeps = find_sweeps(inputs)
    wanted = [name.strip() for name in names.split(",") if name.strip()]
    known = [sweep.name for sweep in sweeps]
    for name in wanted:
        if name not in known:
            raise BeamboxError(f'no sweep is called "{name}"{did_you_mean(name, known)}')
    sweeps = [sweep for sweep in sweeps if not wanted or sweep.name in wanted][: most or None]
    read = partial(read_sweep, fields=fields, intensity_scale=intensity_scale, labels=labels)
    return [Shown(sweep.name, partial(read, sweep)) for sweep in sweeps]


def sweeps_of(
    inputs: Sequence[str],
    source: FrameSource | None,
    names: str,
    most: int,
    *,
    fields: str = "",
    intensity_scale: float | None = None,
    labels: bool = True,
) -> list[Shown]:
    """List what to draw: frames of a data set where one was named, else sweeps; see :func:`of_data_set`."""
    if source is not None:
        return of_data_set(source, names, most)
    return of_files(inputs, names, most, fields or None, intensity_scale, labels)


def detector_for(model: str, source: FrameSource | None, **options: Any) -> Detector | None:
    """Load a detector as :func:`beambox.load` does; a data set's description says its range and its sensor's height.

    Args:
        model: name or path; None is returned where it is empty.
        source: the data set, where one was named.
        options: of :func:`beambox.load`; a range and a height that are given go before the description's.
    """
    from beambox.data.custom import CustomSource
    from beambox.data.custom_config import KITTI_GROUND
    from beambox.infer.predictor import load

    if not model:
        return None
    if isinstance(source, CustomSource):
        options["range"] = options.get("range") or source.config.range
        if options.get("sensor_height") is None and source.config.sensor_height is not None:
            options["sensor_height"] = -KITTI_GROUND  # its frames are shifted so that the ground lies there
    return load(model, **options)
