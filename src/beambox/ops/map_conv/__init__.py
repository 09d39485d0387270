"""Convolutions of bird's-eye-view maps for inference: bias and ReLU inside, and only where a map is not empty ground.

A sweep leaves much of a map as it would be without any point. :class:`GroundedConv` remembers, for each size of map,
what it was given and answered when the network saw an empty sweep (:func:`learning_ground`), and afterwards computes
only the cells that see something else. Which these are is decided by comparing the map with the remembered one, bit by
bit, so nothing need be known of the layers before: the answer is always that of the whole convolution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_numba, choose, exporting, needs_gradient, pinned
from beambox.ops.map_conv import reference
from beambox.ops.map_conv.kernel import Folded, Ground, MapKernel

__all__ = ["GroundedConv", "MapKernel", "learning_ground", "map_conv"]

NARROWEST = 16
"""Channels of the widest vector."""

_learning: ContextVar[bool] = ContextVar("learning", default=False)


def _numba() -> Callable[..., Tensor]:
    from beambox.ops.map_conv import cpu

    return cpu.map_conv


def why_plain(bev: Tensor, kernel: MapKernel) -> str | None:
    """Return why a convolution is left to PyTorch, or None where the fused version is made for it."""
    weights = kernel.tensors()
    if exporting():
        return "a graph is being exported"
    if needs_gradient(bev, *weights):
        return "a gradient is asked for"
    if torch.is_autocast_enabled(bev.device.type):
        return "half precision is asked for"
    if any(tensor.dtype != torch.float32 for tensor in (bev, *weights)):
        return "it is not float32"
    if min(kernel.in_channels, kernel.out_channels) < NARROWEST:
        return f"there are fewer than {NARROWEST} channels"
    if any(weight.is_inference() for weight in weights):
        return "the weights are inference tensors, whose changes cannot be noticed"
    return None


BACKENDS = (
    Backend("numba", can_run_numba, _numba),
    Backend("reference", always, lambda: reference.map_conv),
)


def map_conv(bev: Tensor, kernel: MapKernel, ground: Ground | None = None, out: Tensor | None = None) -> Tensor:
    """Convolve a map.

    Args:
        bev: ``(B, C_in, Y, X)``; channels last is fastest.
        kernel: weights, bias, stride and what follows.
        ground: a map and what this kernel answers to it: cells that see nothing else need not be computed.
        out: ``(B, C_out, Y', X')`` to write to, perhaps a slice of a buffer along the channels, channels last; may lack
            rows and columns at the end.

    Returns:
        ``(B, C_out, Y', X')``, channels last; ``out`` where it was given.

    Raises:
        BeamboxError: if a shape does not fit.
    """
    if not exporting():
        expect_shape("bev", bev, (None, kernel.in_channels, None, None))
        _expect_room(bev, kernel, out)
    able = BACKENDS if why_plain(bev, kernel) is None else BACKENDS[-1:]
    return choose("map_conv", able, bev, *kernel.tensors())(bev, kernel, ground, out)


def _expect_room(bev: Tensor, kernel: MapKernel, out: Tensor | None) -> None:
    size = kernel.size(bev.shape[2:])
    if min(size) < 1:
        raise BeamboxError(f"a map of {tuple(bev.shape[2:])} cells is smaller than the kernel reaches")
    if out is None:
        return
    expect_shape("out", out, (len(bev), kernel.out_channels, None, None))
    short = [n - m for n, m in zip(size, out.shape[2:])]
    if min(short) < 0 or max(short) >= max(1, kernel.stride if kernel.transposed else 1):
        raise BeamboxError(f"`out` must have {size} cells, or fewer than a stride less, got {tuple(out.shape[2:])}")
    if out.stride(1) != 1 or out.stride(2) != out.shape[3] * out.stride(3):
        raise BeamboxError("`out` must be laid out channels last, rows one after the other")


class GroundedConv:
    """A convolution that remembers what it answers to empty ground; call it with a map.

    What is remembered is forgotten when a weight changes. Safe to call from several threads.
    """

    def __init__(self, kernel: MapKernel) -> None:
        self.kernel = kernel
        self._grounds: dict[tuple[int, ...], Ground] = {}

    def is_fused(self, bev: Tensor) -> bool:
        """Tell whether bias, ReLU and writing to a place of a buffer cost nothing of their own."""
        if pinned() == "reference" or why_plain(bev, self.kernel) is not None:
            return False
        return can_run_numba(bev, *self.kernel.tensors()) is None

    def __call__(self, bev: Tensor, out: Tensor | None = None) -> Tensor:
        """Convolve, as :func:`map_conv` says."""
        if self.kernel.weight.is_inference():  # it does not count its changes
            return map_conv(bev, self.kernel, None, out)
        place = (*bev.shape[2:], *(() if out is None else out.shape[2:]))
        if not _learning.get():
            ground = self._grounds.get(place)
            if ground is not None and ground.state != self.kernel.state():
                self._grounds.clear()
                ground = None
            return map_conv(bev, self.kernel, ground, out)
        out = map_conv(bev, self.kernel, None, out)
        if bev.device.type == "cpu" and bev.dtype == out.dtype == torch.float32:
            while len(self._grounds) >= MOST:
                self._grounds.pop(next(iter(self._grounds)))
            self._grounds[place] = Ground(Folded.of(bev), Folded.of(out), self.kernel.state())
        return out


MOST = 8
"""Sizes of maps that a convolution remembers."""


@contextmanager
def learning_ground() -> Iterator[None]:
    """Within, in this thread, every :class:`GroundedConv` takes what it is given for empty ground and remembers it."""
    token = _learning.set(True)
    try:
        yield
    finally:
        _learning.reset(token)
