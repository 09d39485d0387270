"""Open a data set of any known layout."""

from __future__ import annotations

from pathlib import Path

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.custom import CustomSource
from beambox.data.folder import FolderSource
from beambox.data.kitti import KittiSource
from beambox.data.nuscenes import NuScenesSource, nuscenes_tables
from beambox.data.once import OnceSource
from beambox.data.source import FrameSource

__all__ = ["open_dataset"]


def open_dataset(path: Path | str, split: str = "val", *, fov: bool = False) -> FrameSource:
    """Open a data set: a YAML file that describes one, a folder of KITTI, ONCE or nuScenes, or points/ and labels/.

    Args:
        path: the file or folder.
        split: name of the list of frames; "all" is every frame.
        fov: keep only what the camera sees, where the layout has a camera.

    Raises:
        MissingFileError: if nothing is there.
        BeamboxError: if it is no data set.
    """
    path = Path(path)
    if path.suffix.lower() in (".yaml", ".yml"):
        return CustomSource(path, split)
    if not path.exists():
        raise MissingFileError(f"{path} is not there; give a data set's folder, or the YAML file that describes it")
    if not path.is_dir():
        raise BeamboxError(f"{path} is no data set; give a folder in KITTI's or ONCE's layout, or a YAML file")
    if nuscenes_tables(path) is not None:
        return NuScenesSource(path, split)
    if (path / "data").is_dir() and not (path / "training").is_dir():
        return OnceSource(path, split)
    if (path / "points").is_dir():
        return FolderSource(path, split)
    return KittiSource(path, split, fov=fov)
