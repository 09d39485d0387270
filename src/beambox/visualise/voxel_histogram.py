"""How many points a voxel holds: the long-tailed histogram that DenNet starts from (its figure 2)."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from PIL import Image
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.structures import Frame

__all__ = ["VoxelHistogram", "draw_histogram", "points_per_voxel", "voxel_histogram"]


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
        held = points_per_voxel(frame.points, cell).clamp(max=most)
        total += torch.bincount(held - 1, minlength=most)
        seen += 1
    return VoxelHistogram(tuple(total.tolist()), cell, seen)


def draw_histogram(histogram: VoxelHistogram, title: str = "") -> Image.Image:
    """Draw the shares as bars, as DenNet's figure 2."""
    from matplotlib.figure import Figure

    shares = histogram.shares()
    labels = [str(number) for number in range(1, len(shares))] + [f"{len(shares)}+"]
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.add_subplot()
    bars = axes.bar(labels, shares)
    axes.bar_label(bars, [f"{100 * share:.1f} %" for share in shares], fontsize=7)
    axes.set_xlabel("points in a voxel")
    axes.set_ylabel("share of the occupied voxels")
    axes.set_title(title)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return Image.open(file).convert("RGB")
