"""beambox: LiDAR sweeps in, 3-D boxes out.

>>> import beambox
>>> detector = beambox.load("pointpillars-sim")
>>> detections = detector("scan.bin")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from beambox.checks import BeamboxError as BeamboxError
    from beambox.data.kitti import KittiSource as KittiSource
    from beambox.data.reading import read_frame as read_frame
    from beambox.geometry.calibration import Calibration as Calibration
    from beambox.geometry.grid import VoxelGrid as VoxelGrid
    from beambox.infer.predictor import Detector as Detector
    from beambox.infer.predictor import load as load
    from beambox.structures import Batch as Batch
    from beambox.structures import Detection as Detection
    from beambox.structures import Detections as Detections
    from beambox.structures import Frame as Frame
    from beambox.structures import Labels as Labels

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
    "Labels": "beambox.structures",
    "VoxelGrid": "beambox.geometry.grid",
    "load": "beambox.infer.predictor",
    "read_frame": "beambox.data.reading",
}
__all__ = sorted(_PUBLIC)  # noqa: PLE0605  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'beambox' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
