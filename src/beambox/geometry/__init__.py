"""Boxes, angles, calibration and grids: plain torch, no state."""

from beambox.geometry.boxes import corners_3d, corners_bev, rotate_z, wrap_angle
from beambox.geometry.calibration import Calibration, CameraBoxes
from beambox.geometry.grid import VoxelGrid

__all__ = ["Calibration", "CameraBoxes", "VoxelGrid", "corners_3d", "corners_bev", "rotate_z", "wrap_angle"]
