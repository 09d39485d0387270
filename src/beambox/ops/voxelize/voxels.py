"""What voxelization yields."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from beambox.geometry.grid import VoxelGrid

__all__ = ["Voxels"]


@dataclass(frozen=True)
class Voxels:
    """Points grouped by the cells they fall into; K kept points in V voxels."""

    points: Tensor
    """``(K, C)`` kept points, grouped by voxel, in scan order inside a voxel."""
    voxel: Tensor
    """``(K,)`` int64 row of each point's voxel, ascending."""
    count: Tensor
    """``(V,)`` int64 kept points of each voxel, at least 1."""
    index: Tensor
    """``(V, 4)`` int64 (sample, z, y, x); samples ascending, then in order of first appearance."""
    batch_size: int
    """Number of samples; some may have no voxel."""
    grid: VoxelGrid
    """The cells."""

    def __len__(self) -> int:
        return len(self.index)
