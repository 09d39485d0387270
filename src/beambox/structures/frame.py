"""One sweep and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_dtype
from beambox.geometry.calibration import Calibration
from beambox.structures.labels import Labels

__all__ = ["Frame"]


@dataclass(frozen=True)
class Frame:
    """A LiDAR sweep; points outside a camera's view, labels and camera are optional."""

    points: Tensor
    """``(N, 4 or more)`` float32: x, y, z in metres (LiDAR frame), intensity in [0, 1], then any further fields."""
    id: str = ""
    """Name of the frame, unique in its data set."""
    labels: Labels | None = None
    """Ground truth, or None where nobody labelled the frame."""
    calibration: Calibration | None = None
    """Camera calibration, where there is one."""
    image_path: Path | None = None
    """Camera image, where there is one."""
    image_size: tuple[int, int] | None = None
    """(width, height) of the camera image in pixels."""
    plane: Tensor | None = None
    """``(4,)`` road plane a, b, c, d with ax + by + cz + d = 0 in the LiDAR frame, unit normal pointing up."""
    notes: tuple[str, ...] = ()
    """What reading had to decide: points dropped, intensity scaled or filled."""

    def __post_init__(self) -> None:
        if self.points.dim() != 2 or self.points.shape[1] < 4:
            raise BeamboxError(
                f"`points` must have shape (N, 4 or more): x, y, z, intensity; got {tuple(self.points.shape)}"
            )
        expect_dtype("points", self.points, torch.float32)

    def __len__(self) -> int:
        return len(self.points)

    def with_points(self, points: Tensor) -> Frame:
        """Return the same frame with other points."""
        return replace(self, points=points)

    def camera_view(self) -> Frame:
        """Keep only the points that the camera sees (KITTI labels exist only there).

        Raises:
            BeamboxError: without a calibration or an image size.
        """
        if self.calibration is None or self.image_size is None:
            raise BeamboxError(
                f"frame {self.id or '(unnamed)'} has no camera calibration, so its points cannot be cropped to the "
                "camera's view; give the calib file or keep all points"
            )
        return self.with_points(self.points[self.calibration.in_view(self.points, self.image_size)])
