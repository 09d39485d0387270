"""What a tracker knows after a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from beambox.checks import expect_same_length, expect_shape
from beambox.structures import Detections

__all__ = ["Tracks"]


@dataclass(frozen=True)
class Tracks:
    """The objects of one sweep with identities and velocities; slices like a sequence."""

    detections: Detections
    """Boxes (as filtered over time), scores and classes."""
    ids: Tensor
    """``(N,)`` int64 identity of each object, from 1; never given twice by one tracker."""
    velocities: Tensor
    """``(N, 3)`` metres per second along the axes of the LiDAR frame; over ground where poses were given, otherwise
    relative to the sensor."""
    ages: Tensor
    """``(N,)`` seconds since the object was first seen."""
    missed: Tensor
    """``(N,)`` seconds since its last detection: 0 where this sweep has one."""
    time: float = 0.0
    """Of the sweep, seconds."""

    def __post_init__(self) -> None:
        expect_shape("velocities", self.velocities, ("N", 3))
        expect_same_length(
            detections=len(self.detections),
            ids=len(self.ids),
            velocities=len(self.velocities),
            ages=len(self.ages),
            missed=len(self.missed),
        )

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: Tensor | Sequence[bool] | slice) -> Tracks:
        """Select by a boolean mask, an index tensor or a slice."""
        if not isinstance(index, slice):
            index = torch.as_tensor(index)
        return Tracks(
            self.detections[index],
            self.ids[index],
            self.velocities[index],
            self.ages[index],
            self.missed[index],
            self.time,
        )

    @property
    def names(self) -> list[str]:
        """Class of each object."""
        return list(self.detections.names)

    @property
    def speeds(self) -> Tensor:
        """``(N,)`` metres per second, in BEV."""
        return self.velocities[:, :2].norm(dim=1)

    def to_rows(self) -> list[dict[str, float | int | str]]:
        """Return one flat record per object: those of its detection, and id, vx, vy, vz, age, missed and time."""
        moving = torch.cat((self.velocities, self.ages[:, None], self.missed[:, None]), dim=1).tolist()
        keys = ("vx", "vy", "vz", "age", "missed")
        return [
            {**row, "id": number, **dict(zip(keys, numbers)), "time": self.time}
            for row, number, numbers in zip(self.detections.to_rows(), self.ids.tolist(), moving)
        ]
