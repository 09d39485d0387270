"""From what a user names (files, folders, patterns) to frames, with whatever lies beside a sweep in KITTI's layout."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.formats.recording import ENDINGS, recording_of, sweeps_in
from beambox.data.kitti import DEFAULT_IMAGE_SIZE, image_boxes_given, png_size, read_calibration, read_labels
from beambox.data.read_points import read_frame, readable_suffixes
from beambox.io import read_text
from beambox.structures import Frame

__all__ = ["Sweep", "calibration_beside", "find_sweeps", "read_sweep"]


@dataclass(frozen=True)
class Sweep:
    """One file to look at, and the name its results get."""

    path: Path
    """The points."""
    name: str
    """Unique among the inputs; may hold folders where files of one name lie in several."""


def find_sweeps(inputs: Sequence[str | Path]) -> list[Sweep]:
    """List the sweeps that files, folders and patterns name, in order and without repeats.

    A folder gives its sweeps, sorted; one in KITTI's layout those of velodyne/ or training/velodyne/. A recording of
    ROS (.bag, .mcap, .db3, a folder of rosbag2) gives its point clouds, as paths RECORDING/TOPIC/NANOSECONDS.

    Raises:
        MissingFileError: if a file, folder or pattern names nothing.
    """
    paths: dict[Path, None] = {}
    for given in inputs:
        paths.update(dict.fromkeys(_expand(str(given))))
    return _named(list(paths))


def _expand(given: str) -> list[Path]:
    path, suffixes = Path(given), readable_suffixes()
    if recording_of(path) is not None:
        return sweeps_in(path)
    if path.is_dir():
        for folder in (path, path / "velodyne", path / "training" / "velodyne", path / "testing" / "velodyne"):
            found = sorted(p for p in folder.glob("*") if p.suffix.lower() in (*suffixes, *ENDINGS))
            if found:
                return _each(found)
        raise MissingFileError(f"{given} holds no sweep; looked for {' '.join('*' + e for e in suffixes)}")
    if path.exists():
        return [path]
    if glob.has_magic(given):
        found = sorted(Path(p) for p in glob.glob(given, recursive=True) if Path(p).is_file())
        if found:
            return _each(found)
        raise MissingFileError(f"no file fits the pattern {given}")
    beside = sorted(p.name for p in path.parent.glob("*") if p.suffix.lower() in suffixes)[:3]
    hint = f"; {path.parent}/ holds {', '.join(beside)} ..." if beside else ""
    raise MissingFileError(f"{given} is not there{hint}")


def _each(paths: Sequence[Path]) -> list[Path]:
    """Put the sweeps of recordings in their places."""
    return [sweep for path in paths for sweep in (sweeps_in(path) if path.suffix.lower() in ENDINGS else [path])]


def _named(paths: list[Path]) -> list[Sweep]:
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return [Sweep(path, path.stem) for path in paths]
    whole = [path.resolve() for path in paths]
    shared = 0  # leading parts that all have
    while all(len(p.parts) > shared + 1 for p in whole) and len({p.parts[shared] for p in whole}) == 1:
        shared += 1
    names = ["/".join((*p.parts[shared:-1], p.stem)) for p in whole]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise BeamboxError(f'two inputs are both called "{twice}" and differ only in their ending; give one of them')
    return [Sweep(path, name) for path, name in zip(paths, names)]


def read_sweep(
    sweep: Sweep | Path | str,
    *,
    fields: str | Sequence[str] | None = None,
    intensity_scale: float | None = None,
    labels: bool = False,
) -> Frame:
    """Read a sweep, and the calibration, image and labels that lie beside it in KITTI's layout.

    For ``DIR/velodyne/ID.bin`` these are ``DIR/calib/ID.txt``, ``DIR/image_2/ID.png`` and ``DIR/label_2/ID.txt``.

    Args:
        sweep: the file.
        fields: names of the columns, see :func:`beambox.data.read_points.read_frame`.
        intensity_scale: factor that brings the intensity to [0, 1]; found from the numbers where None.
        labels: read the labels too.
    """
    sweep = sweep if isinstance(sweep, Sweep) else Sweep(Path(sweep), Path(sweep).stem)
    frame = replace(read_frame(sweep.path, fields=fields, intensity_scale=intensity_scale), id=sweep.name)
    calib = calibration_beside(sweep.path)
    if calib is None:
        return frame
    calibration = read_calibration(calib)
    folder, stem = sweep.path.parent.parent, sweep.path.stem
    image, label = folder / "image_2" / f"{stem}.png", folder / "label_2" / f"{stem}.txt"
    camera = image.exists() or not label.exists() or image_boxes_given(read_text(label)) is not False
    if not camera:  # labels made without a camera: no image to crop to
        notes = "all image boxes are 0 (labels made without a camera): points are not cropped to a camera's view"
        frame = replace(frame, notes=(*frame.notes, notes))
    return replace(
        frame,
        calibration=calibration,
        image_path=image if image.exists() else None,
        image_size=png_size(image) if image.exists() else DEFAULT_IMAGE_SIZE if camera else None,
        labels=read_labels(label, calibration) if labels and label.exists() else None,
    )


def calibration_beside(sweep: Path) -> Path | None:
    """Return the calibration that KITTI's layout puts beside a sweep: ../calib/ID.txt of velodyne/ID.bin."""
    path = sweep.parent.parent / "calib" / f"{sweep.stem}.txt"
    return path if sweep.parent.name == "velodyne" and path.exists() else None
