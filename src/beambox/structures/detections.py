"""What a detector found in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_same_length, expect_shape
from beambox.geometry.calibration import Calibration
from beambox.io import name_to_word

__all__ = ["Detections"]


@dataclass(frozen=True)
class Detections:
    """Boxes with scores and classes, best first as detectors return them; slices like a sequence."""

    boxes: Tensor
    """``(N, 7)`` x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""
    scores: Tensor
    """``(N,)`` confidence in [0, 1]."""
    labels: Tensor
    """``(N,)`` int64 position of the class in ``classes``."""
    classes: tuple[str, ...]
    """Names of the detector's classes."""
    frame_id: str = ""
    """Name of the frame."""

    def __post_init__(self) -> None:
        expect_shape("boxes", self.boxes, ("N", 7))
        expect_shape("scores", self.scores, ("N",))
        expect_same_length(boxes=len(self.boxes), scores=len(self.scores), labels=len(self.labels))
        if len(self.labels) and not 0 <= int(self.labels.min()) <= int(self.labels.max()) < len(self.classes):
            raise BeamboxError(
                f"`labels` must lie in 0 to {len(self.classes) - 1}, the positions in `classes`, "
                f"got {int(self.labels.min())} to {int(self.labels.max())}"
            )

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, index: Tensor | Sequence[bool] | slice) -> Detections:
        """Select by a boolean mask, an index tensor or a slice."""
        if not isinstance(index, slice):
            index = torch.as_tensor(index, device=self.scores.device)
        return replace(self, boxes=self.boxes[index], scores=self.scores[index], labels=self.labels[index])

    @property
    def names(self) -> list[str]:
        """Class name of each detection."""
        return [self.classes[i] for i in self.labels.tolist()]

    @classmethod
    def empty(cls, classes: Sequence[str] = (), frame_id: str = "") -> Detections:
        """Nothing found."""
        return cls(torch.zeros(0, 7), torch.zeros(0), torch.zeros(0, dtype=torch.int64), tuple(classes), frame_id)

    def to(self, device: torch.device | str) -> Detections:
        """Move to a device."""
        return replace(self, boxes=self.boxes.to(device), scores=self.scores.to(device), labels=self.labels.to(device))

    def to_kitti(self, calibration: Calibration, image_size: tuple[int, int] | None = None) -> str:
        """Write KITTI's result lines, one a detection, in order.

        Args:
            calibration: of the frame; KITTI's boxes live in its camera.
            image_size: (width, height) to clip the image boxes to; None leaves them unclipped.

        Returns:
            Text, every line ended by a newline; empty where nothing was found.
        """
        camera = calibration.to_camera(self.boxes.cpu(), image_size)
        columns = torch.cat(
            (
                camera.alpha[:, None],
                camera.image,
                camera.size,
                camera.location,
                camera.rotation_y[:, None],
                self.scores.detach().cpu().double()[:, None],
            ),
            dim=1,
        )  # (N, 13)
        lines = (
            f"{name_to_word(name)} -1 -1 " + " ".join(f"{value:.4f}" for value in row) + "\n"
            for name, row in zip(self.names, columns.tolist())
        )
        return "".join(lines)

    def to_rows(self) -> list[dict[str, float | str]]:
        """Return one flat record a detection, in the LiDAR frame, for JSON and CSV."""
        keys = ("x", "y", "z", "l", "w", "h", "yaw")
        boxes, scores = self.boxes.cpu().tolist(), self.scores.cpu().tolist()
        return [
            {"frame": self.frame_id, "name": name, "score": score, **dict(zip(keys, box))}
            for name, score, box in zip(self.names, scores, boxes)
        ]
