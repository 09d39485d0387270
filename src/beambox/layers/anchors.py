"""Anchors: one box size a class at two headings in every cell of a bird's-eye-view map (SECOND, section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from beambox.geometry.grid import VoxelGrid

__all__ = ["KITTI_ANCHORS", "ONCE_ANCHORS", "AnchorClass", "AnchorGrid"]

ROTATIONS = (0.0, 1.57)
"""Headings of the anchors in radians; 1.57 rather than pi/2 as in the published code."""


@dataclass(frozen=True)
class AnchorClass:
    """The anchor of one class."""

    name: str
    """Class."""
    size: tuple[float, float, float]
    """Length, width, height in metres."""
    bottom_z: float
    """Height of the anchors' lower face in the LiDAR frame, metres."""
    matched_threshold: float
    """Overlap with an object from which an anchor is positive."""
    unmatched_threshold: float
    """Overlap below which an anchor is negative."""


# Sizes, heights and thresholds of the public toolbox (OpenPCDet's kitti and once configurations).
KITTI_ANCHORS = (
    AnchorClass("Car", (3.9, 1.6, 1.56), -1.78, 0.60, 0.45),
    AnchorClass("Pedestrian", (0.8, 0.6, 1.73), -0.6, 0.50, 0.35),
    AnchorClass("Cyclist", (1.76, 0.6, 1.73), -0.6, 0.50, 0.35),
)
ONCE_ANCHORS = (
    AnchorClass("Car", (4.38, 1.87, 1.59), -1.71, 0.60, 0.45),
    AnchorClass("Bus", (11.11, 2.88, 3.41), -1.74, 0.55, 0.40),
    AnchorClass("Truck", (7.52, 2.50, 2.62), -1.55, 0.55, 0.40),
    AnchorClass("Pedestrian", (0.75, 0.76, 1.69), -1.62, 0.30, 0.15),
    AnchorClass("Cyclist", (2.18, 0.79, 1.43), -1.65, 0.50, 0.35),
)


_MADE: dict[tuple[AnchorGrid, VoxelGrid, torch.device], Tensor] = {}
_MOST = 16


@dataclass(frozen=True)
class AnchorGrid:
    """Anchors of several classes over a map whose cells are ``stride`` voxels wide.

    With ``centred`` anchors stand at the centres of the map's cells. Without, they stand where the public toolbox puts
    them: evenly spread from the first to the last border of ``region``, so that the spacing is a little wider than a
    cell. Positions are always those of ``region``'s lattice, also when a network looks at another part of space.
    """

    classes: tuple[AnchorClass, ...]
    region: VoxelGrid
    stride: int
    centered: bool = False

    def map_size(self, grid: VoxelGrid) -> tuple[int, int]:
        """Return the map's size (y, x) over ``grid``."""
        nx, ny, _ = grid.size
        return -(-ny // self.stride), -(-nx // self.stride)

    def _positions(self, axis: int, grid: VoxelGrid, count: int) -> Tensor:
        low, high, step = self.region.minimum[axis], self.region.maximum[axis], self.region.cell[axis] * self.stride
        first = round((grid.minimum[axis] - low) / step)
        index = torch.arange(first, first + count, dtype=torch.float64)
        if self.centered:
            return low + (index + 0.5) * step
        of_region = -(-self.region.size[axis] // self.stride)
        return low + index * (high - low) / max(1, of_region - 1)

    def boxes(self, grid: VoxelGrid, device: torch.device | str = "cpu") -> Tensor:
        """Return all anchors over ``grid``, in the order (y, x, class, rotation).

        They are made once per grid and device, and kept: nobody may write to them.

        Returns:
            ``(ny * nx * classes * 2, 7)`` float32.
        """
        if torch.compiler.is_compiling() or torch.compiler.is_exporting():  # what is traced must not outlive the trace
            return self._boxes(grid).to(device)
        key = (self, grid, torch.device(device))
        if key not in _MADE:
            if len(_MADE) >= _MOST:
                _MADE.pop(next(iter(_MADE)))  # training's windows follow one another, and come back
            with torch.inference_mode(False):
                _MADE[key] = self._boxes(grid).to(device)
        return _MADE[key]

    def _boxes(self, grid: VoxelGrid) -> Tensor:
        ny, nx = self.map_size(grid)
        xs, ys = self._positions(0, grid, nx), self._positions(1, grid, ny)
        shapes = torch.tensor(
            [(c.bottom_z + c.size[2] / 2, *c.size, rotation) for c in self.classes for rotation in ROTATIONS],
            dtype=torch.float64,
        )  # (A, 5) z, l, w, h, yaw
        out = torch.empty(ny, nx, len(shapes), 7, dtype=torch.float64)
        out[..., 0] = xs[None, :, None]
        out[..., 1] = ys[:, None, None]
        out[..., 2:] = shapes
        return out.reshape(-1, 7).float()

    @property
    def per_cell(self) -> int:
        """Number of anchors in one cell."""
        return len(self.classes) * len(ROTATIONS)
