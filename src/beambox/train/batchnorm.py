"""Batch-norm statistics measured anew: the mean and variance of what each layer sees of training batches.

The statistics that a batch norm keeps during training are a moving average over networks of the past: with momentum
0.01 and a few hundred steps, or with averaged weights, which no step ever ran, they are far from those of the weights
beside them. Here they are measured for the weights as they are: a batch norm normalizes by its batch, as in training,
and the statistics are those of all values of all batches together, so the variance between batches is in them
(an average of the batches' variances, as PyTorch's ``momentum=None`` keeps, leaves it out and weighs every batch the
same, whatever its number of voxels). Y. Wu, J. Johnson, "Rethinking 'Batch' in BatchNorm", 2021, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd

__all__ = ["Moments", "batch_norms", "measure_statistics", "measured_statistics"]

Work = TypeVar("Work")


class Moments:
    """Count, mean and sum of squared deviations of each channel, added up batch by batch without loss of digits."""

    def __init__(self, channels: int, device: torch.device) -> None:
        self.packed = torch.zeros(3, channels, dtype=torch.float64, device=device)
        """``(3, C)``: number of values, their mean, the sum of their squared deviations from it."""

    def add(self, values: Tensor) -> None:
        """Take in a batch of values ``(N, C, ...)``."""
        if values.numel() == 0:
            return
        dims = [axis for axis in range(values.dim()) if axis != 1]
        variance, mean = torch.var_mean(values.detach().float(), dim=dims, correction=0)  # (C,), (C,)
        count = values.numel() // values.shape[1]
        self.merge(torch.stack((torch.full_like(mean, count), mean, variance * count)).double())

    def hook(self, _: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        """Take in what a layer is about to see; a forward pre-hook."""
        self.add(inputs[0])

    def merge(self, other: Tensor) -> None:
        """Take in the packed moments of other values (Chan, Golub and LeVeque, 1979)."""
        (n, mean, squares), (m, their_mean, their_squares) = self.packed, other
        both, away = (n + m).clamp(min=1), their_mean - mean
        self.packed = torch.stack((n + m, mean + away * m / both, squares + their_squares + away**2 * n * m / both))

    @property
    def statistics(self) -> tuple[Tensor, Tensor] | None:
        """Mean and variance (of the population, estimated as PyTorch does), ``(C,)``; None below two values."""
        count, mean, squares = self.packed
        return None if bool((count < 2).any()) else (mean, squares / (count - 1))


def batch_norms(model: nn.Module) -> dict[str, _BatchNorm]:
    """Return the layers that keep statistics, by name."""
    return {
        name: layer
        for name, layer in model.named_modules()
        if isinstance(layer, _BatchNorm) and layer.running_mean is not None
    }


@torch.no_grad()
def measure_statistics(
    model: nn.Module,
    batches: Iterable[Work],
    forward: Callable[[Work], object],
    gather: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Replace the statistics of a model's batch norms by those of some batches.

    The model runs in training mode, except for its dropout, which the network in use does not have. A layer that saw
    fewer than two values keeps what it had. Modes and counters of batches are as before afterwards.

    Args:
        model: whose statistics.
        batches: what it sees; none leaves everything as it is.
        forward: runs the model on a batch, the loss included where a part of the model runs only there.
        gather: returns a tensor ``(...)`` of all processes as ``(processes, ...)``; None where there is one process.
    """
    layers = batch_norms(model)
    moments = {name: Moments(layer.num_features, layer.running_mean.device) for name, layer in layers.items()}  # pyright: ignore[reportOptionalMemberAccess]
    former = {name: [buffer.clone() for buffer in layer.buffers()] for name, layer in layers.items()}
    with ExitStack() as stack:
        stack.enter_context(_training_without_dropout(model))
        stack.enter_context(_following(layers.values()))
        stack.enter_context(torch.compiler.set_stance("force_eager"))  # compiled code would not see the hooks
        for name, layer in layers.items():
            stack.callback(layer.register_forward_pre_hook(moments[name].hook).remove)
        for work in batches:
            forward(work)
    for name, layer in layers.items():
        for buffer, value in zip(layer.buffers(), former[name], strict=True):
            buffer.copy_(value)
        own = moments[name]
        if gather is not None:
            parts = gather(own.packed)  # (processes, 3, C)
            own = Moments(layer.num_features, parts.device)
            for part in parts:
                own.merge(part)
        if own.statistics is not None:
            assert layer.running_mean is not None and layer.running_var is not None
            layer.running_mean.copy_(own.statistics[0])
            layer.running_var.copy_(own.statistics[1])


@contextmanager
def measured_statistics(model: nn.Module, measure: Callable[[], None]) -> Iterator[None]:
    """Measure on entry, and put back on exit what the batch norms held: training goes on as if nothing had happened."""
    former = {name: buffer.clone() for name, buffer in model.named_buffers()}
    try:
        measure()
        yield
    finally:
        with torch.no_grad():
            for name, buffer in model.named_buffers():
                buffer.copy_(former[name])


@contextmanager
def _training_without_dropout(model: nn.Module) -> Iterator[None]:
    modes = [(module, module.training) for module in model.modules()]
    model.train()
    for module in model.modules():
        if isinstance(module, _DropoutNd):
            module.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode


@contextmanager
def _following(layers: Iterable[_BatchNorm]) -> Iterator[None]:
    """Let the layers' own statistics follow the batches: what reads them on the way sees the present weights'."""
    momenta = [(layer, layer.momentum) for layer in layers]
    for layer, _ in momenta:
        layer.momentum = None  # a cumulative average, since the layer's reset
        layer.reset_running_stats()
    try:
        yield
    finally:
        for layer, momentum in momenta:
            layer.momentum = momentum
