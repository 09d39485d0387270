"""How many points a voxel holds: the long-tailed histogram that DenNet starts from (its figure 2)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from PIL import Image
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.structures import Frame
from beambox.visualize.canvas import Canvas
from beambox.visualize.colors import Color

__all__ = ["VoxelHistogram", "draw_histogram", "points_per_voxel", "voxel_histogram"]

WHITE: Color = (255, 255, 255)
BLACK: Color = (20, 20, 20)
BAR: Color = (46, 104, 172)


@dataclass(frozen=True)
class VoxelHistogram:
    """Occupied voxels by the number of points they hold, over several sweeps."""

    voxels: tuple[int, ...]
    """How many voxels hold 1, 2, ... points; the last number counts those that hold at least so many."""
    cell: tuple[float, float, float]
    """Edge lengths of a voxel x, y, z in metres."""
    frames: int
    """Number of sweeps."""

    def shares(self) -> tuple[float, ...]:
        """Return the share of each number of points among all occupied voxels, summing to 1."""
        total = max(1, sum(self.voxels))
        return tuple(count / total for count in self.voxels)

    def table(self) -> str:
        """Return the shares as text."""
        most, size = len(self.voxels), " x ".join(f"{edge:g}" for edge in self.cell)
        lines = [f"{sum(self.voxels)} occupied voxels of {size} m in {self.frames} sweeps", "points   voxels"]
        for number, share in enumerate(self.shares(), 1):
            label = f"{number}{'+' if number == most else ''}"
            lines.append(f"{label:>6}  {100 * share:6.2f} %  {'#' * round(50 * share)}".rstrip())
        return "\n".join(lines) + "\n"


def points_per_voxel(points: Tensor, cell: tuple[float, float, float]) -> Tensor:
    """Count the points of each occupied voxel.

    Args:
        points: ``(N, 3 or more)``; x, y, z in metres first; those that are not finite are left out.
        cell: edge lengths x, y, z of voxels, one of which has a corner at the origin.

    Returns:
        ``(V,)`` int64, in no useful order.
    """
    if min(cell) <= 0:
        raise BeamboxError(f"`cell` must be three lengths above 0, got {tuple(cell)}")
    xyz = points[points[:, :3].isfinite().all(dim=1), :3].double()
    index = torch.floor(xyz / torch.tensor(cell, dtype=torch.float64)).long()  # (N, 3)
    key = torch.zeros(len(index), dtype=torch.int64)
    for axis in index.unbind(dim=1):  # places along an axis are numbered first, so that one far point costs nothing
        places, place = axis.unique(return_inverse=True)
        key = key * len(places) + place
    return key.unique(return_counts=True)[1]


def voxel_histogram(frames: Iterable[Frame], cell: tuple[float, float, float], most: int = 10) -> VoxelHistogram:
    """Count voxels by their points over whole sweeps.

    Args:
        frames: sweeps.
        cell: edge lengths x, y, z in metres; DenNet: 0.1, 0.1, 0.15 for KITTI and 0.1, 0.1, 0.2 for ONCE.
        most: numbers of points told apart; the last one gathers all above.
    """
    if most < 1:
        raise BeamboxError(f"`most` must be at least 1, got {most}")
    total, seen = torch.zeros(most, dtype=torch.int64), 0
    for frame in frames:
        counts = points_per_voxel(frame.points, cell).clamp(max=most)
        total += torch.bincount(counts - 1, minlength=most)
        seen += 1
    return VoxelHistogram(tuple(total.tolist()), cell, seen)


def draw_histogram(histogram: VoxelHistogram, title: str = "") -> Image.Image:
    """Draw the shares as bars, as DenNet's figure 2; 750 x 600 pixels."""
    shares = histogram.shares()
    canvas = Canvas(750, 600, WHITE)
    left, right, top, bottom = 90, 730, 60, 530  # edges of the axes in pixels
    highest = max(shares) or 1.0
    width = (right - left) / len(shares)
    for number, share in enumerate(shares, 1):
        u0, u1 = left + (number - 0.9) * width, left + (number - 0.1) * width
        v = bottom - (bottom - top - 20) * share / highest
        canvas.polygon([(u0, bottom), (u0, v), (u1, v), (u1, bottom)], BAR)
        canvas.text(((u0 + u1) / 2, v - 9), f"{100 * share:.1f} %", BLACK, 12, "mm")
        label = f"{number}{'+' if number == len(shares) else ''}"
        canvas.text(((u0 + u1) / 2, bottom + 16), label, BLACK, 14, "mm")
    canvas.line([(left, top), (left, bottom), (right, bottom), (right, top), (left, top)], BLACK)
    for tick in range(5):
        share, v = highest * tick / 4, bottom - (bottom - top - 20) * tick / 4
        canvas.line([(left - 5, v), (left, v)], BLACK)
        canvas.text((left - 9, v), f"{100 * share:.3g} %", BLACK, 14, "rm")
    canvas.text(((left + right) / 2, 32), title, BLACK, 18, "mm")
    canvas.text(((left + right) / 2, 572), "points per voxel (vertical: share of the occupied voxels)", BLACK, 16, "mm")
    return canvas.finish()
