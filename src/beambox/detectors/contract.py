"""What every detector offers: three explicit calls, and nothing kept between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError
from beambox.geometry.grid import VoxelGrid
from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels

__all__ = [
    "AnyModel",
    "DetectorConfig",
    "DetectorModel",
    "Foldable",
    "detections_from",
    "expect_made",
    "model_of",
    "module_of",
    "targets_from",
]


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
    def num_point_features(self) -> int:
        """Values of a point that the network reads: x, y, z, intensity, ..."""
        ...

    @property
    def absolute_xy(self) -> bool:
        """Whether x and y enter as seen from the sensor, so that what was learnt holds in the trained region alone."""
        ...


@runtime_checkable
class Foldable(Protocol):
    """A layer with batch norms that can take them into its weights, for inference."""

    def fold(self) -> None:
        """Do so for good; what it computes in evaluation mode stays the same."""
        ...


P = TypeVar("P")


@runtime_checkable
class DetectorModel(Protocol[P]):
    """A network, its loss and its decoding.

    To detect: ``predictions = model(batch)``, ``detections = model.decode(predictions)``. To learn:
    ``predictions = model(batch, labels=labels)``, ``losses = model.loss(predictions, labels)``: a network with a second
    step looks, given labels, at the boxes it can learn from. The model keeps parameters, not results.

    A detector is also a :class:`torch.nn.Module` (:func:`module_of`); what is asked of it as one stands here too.
    """

    training: bool

    @property
    def config(self) -> DetectorConfig:
        """What it was built from."""
        ...

    @property
    def dense(self) -> tuple[nn.Module, ...]:
        """Layers that work on whole maps: what it pays to compile, as training does with ``compile: true``."""
        ...

    def __call__(self, batch: Batch, grid: VoxelGrid | None = None, labels: Sequence[Labels] | None = None) -> P:
        """Predict.

        Args:
            batch: sweeps.
            grid: another region with cells of the same size; the configured one where None.
            labels: ground truth of each sweep, from which a second step chooses what it learns on; None to detect.
        """
        ...

    def loss(self, predictions: P, labels: Sequence[Labels]) -> dict[str, Tensor]:
        """Return named scalars, each already weighted: their sum is the total.

        Raises:
            BeamboxError: where the network has a second step and predicted without labels.
        """
        ...

    def decode(self, predictions: P) -> list[Detections]:
        """Return the detections of each sample, best first.

        Raises:
            BeamboxError: where the network has a second step and predicted with labels.
        """
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """As :class:`torch.nn.Module`'s."""
        ...

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """As :class:`torch.nn.Module`'s."""
        ...

    def state_dict(self) -> Mapping[str, Tensor]:
        """As :class:`torch.nn.Module`'s."""
        ...


AnyModel: TypeAlias = DetectorModel[Any]
"""A detector whatever its predictions are: they go from its forward pass to its loss or its decoding unread."""


def module_of(model: AnyModel) -> nn.Module:
    """Return a detector as the module it is.

    Raises:
        BeamboxError: if it is none.
    """
    if not isinstance(model, nn.Module):
        raise BeamboxError(f"a detector must be a torch.nn.Module, got {type(model).__name__}")
    return model


def model_of(module: nn.Module) -> AnyModel:
    """Return a module as the detector it is.

    Raises:
        BeamboxError: naming what it lacks.
    """
    if isinstance(module, DetectorModel):
        return module
    lacking = [name for name in ("config", "dense", "loss", "decode") if not hasattr(module, name)]
    raise BeamboxError(f"{type(module).__name__} is no detector: it has no {', '.join(lacking)}")


def expect_made(with_labels: bool, wanted: bool) -> None:
    """Refuse to learn from predictions made to detect, and to detect from those made to learn."""
    if wanted and not with_labels:
        raise BeamboxError("`loss` needs predictions made with labels: call model(batch, labels=labels)")
    if with_labels and not wanted:
        raise BeamboxError("`decode` needs predictions made without labels: call model(batch)")


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
