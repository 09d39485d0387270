"""beambox: LiDAR sweeps in, 3-D boxes out.

>>> import beambox
>>> detector = beambox.load("pointpillars-sim")
>>> detections = detector("scan.bin")
>>> scores = beambox.evaluate("pointpillars-sim", "data")

Everything public is an attribute of this module and loaded on first use. docs/reference.md lists it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from beambox.checks import BeamboxError as BeamboxError
    from beambox.data.kitti import KittiSource as KittiSource
    from beambox.data.read_points import read_frame as read_frame
    from beambox.geometry.calibration import Calibration as Calibration
    from beambox.geometry.grid import VoxelGrid as VoxelGrid
    from beambox.infer.predictor import Detector as Detector
    from beambox.infer.predictor import load as load
    from beambox.structures import Batch as Batch
    from beambox.structures import Detection as Detection
    from beambox.structures import Detections as Detections
    from beambox.structures import Frame as Frame
    from beambox.structures import Label as Label
    from beambox.structures import Labels as Labels
    from beambox.verbs import draw as draw
    from beambox.verbs import evaluate as evaluate
    from beambox.verbs import export as export
    from beambox.verbs import open_dataset as open_dataset
    from beambox.verbs import recipes as recipes
    from beambox.verbs import simulate as simulate
    from beambox.verbs import train as train

__version__ = "0.1.0"

# Name -> module that defines it. Loaded on first use, so that importing beambox is fast and `beambox --help` instant.
_PUBLIC = {
    "Batch": "beambox.structures",
    "BeamboxError": "beambox.checks",
    "Calibration": "beambox.geometry.calibration",
    "Detection": "beambox.structures",
    "Detections": "beambox.structures",
    "Detector": "beambox.infer.predictor",
    "Frame": "beambox.structures",
    "KittiSource": "beambox.data.kitti",
    "Label": "beambox.structures",
    "Labels": "beambox.structures",
    "VoxelGrid": "beambox.geometry.grid",
    "draw": "beambox.verbs",
    "evaluate": "beambox.verbs",
    "export": "",
    "load": "beambox.infer.predictor",
    "open_dataset": "beambox.verbs",
    "read_frame": "beambox.data.read_points",
    "recipes": "beambox.verbs",
    "simulate": "",
    "train": "",
}  # "": a package of that name, which can be called
__all__ = sorted(_PUBLIC)  # noqa: PLE0605  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'beambox' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name) if _PUBLIC[name] else import_module(f"beambox.{name}")


def __dir__() -> list[str]:
    return sorted(__all__)
