"""Sweeps joined for one pass through a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_same_length
from beambox.structures.frame import Frame
from beambox.structures.labels import Labels

__all__ = ["Batch", "expect_columns"]


@dataclass(frozen=True)
class Batch:
    """Points of several sweeps, one after the other; never padded."""

    points: Tensor
    """``(N, C)`` float32 x, y, z, intensity, ..."""
    sample: Tensor
    """``(N,)`` int64 position of each point's sweep in the batch, ascending."""
    size: int
    """Number of sweeps; some may be empty."""
    frame_ids: tuple[str, ...] = ()
    """Name of each sweep."""
    labels: tuple[Labels, ...] | None = None
    """Ground truth of each sweep (on the CPU), or None where any lacks it."""

    def __post_init__(self) -> None:
        expect_same_length(points=len(self.points), sample=len(self.sample))

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> Batch:
        """Join frames; all must have the same number of point columns."""
        if not frames:
            raise BeamboxError("a batch needs at least one frame, got none")
        columns = {frame.points.shape[1] for frame in frames}
        if len(columns) > 1:
            raise BeamboxError(f"all frames of a batch need the same number of point columns, got {sorted(columns)}")
        lengths = torch.tensor([len(frame) for frame in frames])
        labels = tuple(frame.labels for frame in frames if frame.labels is not None)
        return cls(
            points=torch.cat([frame.points for frame in frames]),
            sample=torch.repeat_interleave(torch.arange(len(frames)), lengths),
            size=len(frames),
            frame_ids=tuple(frame.id for frame in frames),
            labels=labels if len(labels) == len(frames) else None,
        )

    def to(self, device: torch.device | str) -> Batch:
        """Move the points to a device; labels stay where they are."""
        return replace(
            self, points=self.points.to(device, non_blocking=True), sample=self.sample.to(device, non_blocking=True)
        )


def expect_columns(frame: Frame, columns: int) -> None:
    """Check that a sweep has the columns that a network reads of each point.

    Args:
        frame: the sweep.
        columns: x, y, z, intensity and what else the network takes.

    Raises:
        BeamboxError: if it has fewer.
    """
    if frame.points.shape[1] < columns:
        raise BeamboxError(
            f"the network reads {columns} columns of each point, and sweep {frame.id} has {frame.points.shape[1]}: "
            "name all of them where the file holds them (--fields x,y,z,intensity,...), or take other weights"
        )
