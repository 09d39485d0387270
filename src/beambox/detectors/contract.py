"""What every detector offers: three explicit calls, and nothing kept between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor, nn

from beambox.geometry.grid import VoxelGrid
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = ["DetectorConfig", "DetectorModel", "detections_from", "targets_from"]


class DetectorConfig(Protocol):
    """The least a detector's configuration says."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the network's outputs."""
        ...

    @property
    def grid(self) -> VoxelGrid:
        """The region and the cells the network works on."""
        ...

    @property
    def absolute_xy(self) -> bool:
        """Whether x and y enter as seen from the sensor, so that what was learnt holds in the trained region alone."""
        ...


P = TypeVar("P")


class DetectorModel(Protocol[P]):
    """A network, its loss and its decoding.

    ``predictions = model(batch)``, ``losses = model.loss(predictions, labels)``,
    ``detections = model.decode(predictions)``. The model keeps parameters, not results.
    """

    config: Any

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps: what it pays to compile, as training does with ``compile: true``."""
        ...

    def __call__(self, batch: Batch, grid: VoxelGrid | None = None) -> P:
        """Predict. ``grid``: another region with cells of the same size; the configured one where None."""
        ...

    def loss(self, predictions: P, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return named scalars, each already weighted: their sum is the total."""
        ...

    def decode(self, predictions: P) -> list[Detections]:
        """Return the detections of each sample, best first."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """As :class:`torch.nn.Module`'s."""
        ...

    def state_dict(self) -> Mapping[str, Tensor]:
        """As :class:`torch.nn.Module`'s."""
        ...


def detections_from(kept: Sequence[tuple[Tensor, Tensor, Tensor]], classes: tuple[str, ...]) -> list[Detections]:
    """Wrap (boxes, scores, labels) of each sample."""
    return [Detections(boxes, scores, labels.to(torch.int64), classes) for boxes, scores, labels in kept]


def targets_from(
    labels: Sequence[Labels], classes: tuple[str, ...], device: torch.device
) -> tuple[list[Tensor], list[Tensor]]:
    """Return each sample's boxes ``(M, 7)`` and class positions ``(M,)``; objects of other classes are left out."""
    known = [of_sample.of_classes(classes) for of_sample in labels]
    boxes = [of_sample.boxes.to(device) for of_sample in known]
    return boxes, [of_sample.class_index(classes).to(device) for of_sample in known]
