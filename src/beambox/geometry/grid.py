"""A regular grid of cells over a region of space: the only thing a model needs to know about extent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.geometry.constants import constant

__all__ = ["VoxelGrid"]

MOST_CELLS = 900_000_000
"""Cells of a grid; indices of the sparse operations and a map's features would not fit beyond."""
MOST_CELLS_OF_MAP = 40_000_000
"""Cells in BEV: a region of 300 m in cells of 5 cm."""


@dataclass(frozen=True)
class VoxelGrid:
    """Cells of one size over an axis-aligned box, in the LiDAR frame.

    The region is half open: a point is inside iff ``0 <= floor((p - minimum) / cell) < size``.
    Indices are ordered (z, y, x), sizes and positions (x, y, z).
    """

    minimum: tuple[float, float, float]
    """Lower corner x, y, z in metres."""
    maximum: tuple[float, float, float]
    """Upper corner x, y, z in metres."""
    cell: tuple[float, float, float]
    """Edge lengths of one cell x, y, z in metres."""

    def __post_init__(self) -> None:
        for axis, low, high, step in zip("xyz", self.minimum, self.maximum, self.cell):
            if not all(map(math.isfinite, (low, high, step))):
                raise BeamboxError(f"a grid needs finite numbers, got {low} to {high} by {step} on {axis}")
            if not (high > low and step > 0):
                raise BeamboxError(
                    f"a grid needs minimum < maximum and a positive cell on each axis, "
                    f"got {low} to {high} by {step} on {axis}"
                )

        cells = [max(1.0, (high - low) / step) for low, high, step in zip(self.minimum, self.maximum, self.cell)]
        if cells[0] * cells[1] > MOST_CELLS_OF_MAP or math.prod(cells) > MOST_CELLS:
            details = " x ".join(f"{count:.4g}" for count in cells)
            raise BeamboxError(
                f"a grid of {details} cells fits no memory (at most {MOST_CELLS_OF_MAP:.1g} in a map and "
                f"{MOST_CELLS:.1g} in all): take a smaller range or larger cells"
            )

    @property
    def size(self) -> tuple[int, int, int]:
        """Number of cells (x, y, z)."""
        nx, ny, nz = (
            max(1, round((high - low) / step)) for low, high, step in zip(self.minimum, self.maximum, self.cell)
        )
        return nx, ny, nz

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of cells in index order (z, y, x)."""
        nx, ny, nz = self.size
        return nz, ny, nx

    def index(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Find the cell of each point.

        Args:
            points: ``(N, 3 or more)``; the first three columns are x, y, z in metres.

        Returns:
            ``(N, 3)`` int64 cell index (z, y, x), meaningless where outside, and ``(N,)`` bool, inside.
        """
        minimum = constant(self.minimum, points.device, points.dtype)
        cell = constant(self.cell, points.device, points.dtype)
        size = constant(self.size, points.device)
        xyz = torch.floor((points[:, :3] - minimum) / cell)  # (N, 3)
        inside = ((xyz >= 0) & (xyz < size)).all(dim=1)  # NaN compares false, so it is outside
        return torch.where(inside[:, None], xyz, 0.0).long().flip(1), inside

    def center(self, index: Tensor) -> Tensor:
        """Return the geometric centres (x, y, z) of cells given as ``(..., 3)`` (z, y, x): ``(..., 3)`` float32."""
        cell = constant(self.cell, index.device)
        minimum = constant(self.minimum, index.device)
        return (index.flip(-1) + 0.5) * cell + minimum

    def contains(self, centers: Tensor) -> Tensor:
        """Tell which ``(N, 3 or more)`` positions lie in the closed region."""
        low, high = (constant(values, centers.device, centers.dtype) for values in (self.minimum, self.maximum))
        return ((centers[:, :3] >= low) & (centers[:, :3] <= high)).all(dim=1)

    def window(self, first: tuple[int, int], cells: tuple[int, int]) -> VoxelGrid:
        """Return the part of the grid that starts at cell ``first`` (x, y) and spans ``cells`` (x, y); z is kept."""
        (x0, y0, z0), (_, _, z1), (sx, sy, _) = self.minimum, self.maximum, self.cell
        low = (x0 + first[0] * sx, y0 + first[1] * sy, z0)
        high = (low[0] + cells[0] * sx, low[1] + cells[1] * sy, z1)
        return VoxelGrid(low, high, self.cell)
