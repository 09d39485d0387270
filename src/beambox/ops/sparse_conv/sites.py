"""Active sites of a sparse tensor, the geometry of a convolution, and the map between input and output sites."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_graph, can_run_triton, choose, exporting

__all__ = ["ConvSpec", "KernelMap", "Sites", "Triple"]

Triple = tuple[int, int, int]
T = TypeVar("T")


@dataclass(frozen=True)
class ConvSpec:
    """Kernel size, stride, padding and dilation of a convolution, each (z, y, x)."""

    kernel: Triple
    stride: Triple = (1, 1, 1)
    padding: Triple = (0, 0, 0)
    dilation: Triple = (1, 1, 1)
    submanifold: bool = False
    """Keep the input's active sites as the output's (stride 1, odd kernel, padding that centres it)."""

    def __post_init__(self) -> None:
        for name, values, least in (
            ("kernel", self.kernel, 1),
            ("stride", self.stride, 1),
            ("padding", self.padding, 0),
            ("dilation", self.dilation, 1),
        ):
            if len(values) != 3 or min(values) < least:
                raise BeamboxError(f"`{name}` must be three integers (z, y, x) of at least {least}, got {values}")

    @classmethod
    def centered(cls, kernel: Triple, dilation: Triple = (1, 1, 1)) -> ConvSpec:
        """Return the geometry of a submanifold convolution.

        Raises:
            BeamboxError: for an even kernel, which has no centre.
        """
        if any(k % 2 == 0 for k in kernel):
            raise BeamboxError(f"a submanifold convolution needs odd kernel sizes, which have a centre; got {kernel}")
        pz, py, px = (d * (k // 2) for k, d in zip(kernel, dilation))
        return cls(kernel, padding=(pz, py, px), dilation=dilation, submanifold=True)

    @property
    def offsets(self) -> int:
        """Number of kernel offsets K, numbered with x fastest."""
        return math.prod(self.kernel)

    def output_shape(self, shape: Triple) -> Triple:
        """Return ``floor((in + 2 padding - dilation (kernel - 1) - 1) / stride) + 1`` on each axis.

        Raises:
            BeamboxError: where the kernel is larger than the padded input.
        """
        z, y, x = (
            (n + 2 * p - d * (k - 1) - 1) // s + 1
            for n, k, s, p, d in zip(shape, self.kernel, self.stride, self.padding, self.dilation)
        )
        if min(z, y, x) < 1:
            raise BeamboxError(
                f"a kernel of {self.kernel} with dilation {self.dilation} does not fit an input of {shape} "
                f"with padding {self.padding}: the output would be {(z, y, x)}"
            )
        return z, y, x

    def offset_table(self, device: torch.device) -> Tensor:
        """Return ``(K, 3)`` int64: ``k * dilation - padding``, so that input = output * stride + row k."""
        axes = [torch.arange(k, device=device) * d - p for k, d, p in zip(self.kernel, self.dilation, self.padding)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)


def _triton_indices() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.gpu_indices import indices_of

    return indices_of


def _graph_indices() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.graph_indices import indices_of

    return indices_of


def indices_of(keys: Tensor, order: Tensor, shape: Triple) -> Tensor:
    """Return ``(V, 4)`` int64 (b, z, y, x) of each row from ``(V,)`` ascending keys and the row of each."""
    nz, ny, nx = shape
    rest, x = keys // nx, keys % nx
    rest, y = rest // ny, rest % ny
    ascending = torch.stack((rest // nz, rest % nz, y, x), dim=1)
    return torch.empty_like(ascending).index_copy_(0, order, ascending)


INDEX_BACKENDS = (
    Backend("graph", can_run_graph, _graph_indices),
    Backend("triton", can_run_triton, _triton_indices),
    Backend("reference", always, lambda: indices_of),
)


@dataclass(frozen=True, eq=False)
class KernelMap:
    """Which input site feeds which output site through which kernel offset.

    A record of the two sets of sites and the geometry between them. Each backend builds the pairs in the form that
    suits it when it first needs them, and keeps them here.
    """

    source: Sites
    """The ``V_in`` input sites."""
    target: Sites
    """The ``V_out`` output sites."""
    spec: ConvSpec
    """Of the convolution, or of the one that this map inverts."""
    inverse_of: KernelMap | None = None
    """The map of which this one is the inverse, if it is one."""
    built: dict[Callable[[KernelMap], Any], Any] = field(default_factory=dict, repr=False)
    """What backends have built from it."""

    @cached_property
    def inverse(self) -> KernelMap:
        """The same pairs read from output to input: the map of the transposed convolution and of gradients."""
        return self.inverse_of or KernelMap(self.target, self.source, self.spec, self)

    def kept(self, build: Callable[[KernelMap], T]) -> T:
        """Return what a backend builds from this map, such as a table of rows; built once and kept with the map."""
        if build not in self.built:
            self.built[build] = build(self)
        return self.built[build]


@dataclass(frozen=True, eq=False)
class Sites:
    """Where a sparse tensor is active. :meth:`of` checks; the bare constructor trusts.

    The kernel maps of convolutions from these sites are kept here, so that layers on the same sites share them.
    """

    sorted_keys: Tensor
    """``(V,)`` int64 linear positions ``((b Z + z) Y + y) X + x``, ascending, none twice."""
    order: Tensor
    """``(V,)`` int64 row of each sorted key."""
    shape: Triple
    """Spatial extent (z, y, x) in cells."""
    batch_size: int
    """Number of samples; some may be empty."""
    maps: dict[ConvSpec, KernelMap] = field(default_factory=dict, repr=False)
    """Kernel maps found so far."""

    @cached_property
    def indices(self) -> Tensor:
        """``(V, 4)`` int64 (b, z, y, x) of each row."""
        return choose("site_indices", INDEX_BACKENDS, self.sorted_keys)(self.sorted_keys, self.order, self.shape)

    def __len__(self) -> int:
        return len(self.sorted_keys)

    @classmethod
    def of(cls, indices: Tensor, shape: Triple, batch_size: int) -> Sites:
        """Check indices and sort their keys.

        Args:
            indices: ``(V, 4)`` integers (b, z, y, x).
            shape: spatial extent (z, y, x).
            batch_size: number of samples.

        Raises:
            BeamboxError: for an index outside the extent or the batch, or one that occurs twice.
        """
        expect_shape("indices", indices, ("V", 4))
        if indices.dtype not in (torch.int64, torch.int32):
            raise BeamboxError(f"`indices` must be int64 or int32 (b, z, y, x), got {indices.dtype}")
        indices = indices.long()
        extent = torch.tensor((batch_size, *shape), device=indices.device)
        if bool(((indices < 0) | (indices >= extent)).any()):
            low, high = indices.amin(dim=0).tolist(), indices.amax(dim=0).tolist()
            raise BeamboxError(
                f"`indices` (b, z, y, x) must lie in [0, {(batch_size, *shape)}), got values from {low} to {high}"
            )
        sorted_keys, order = torch.sort(linear_keys(indices, shape))
        twice = torch.nonzero(sorted_keys[1:] == sorted_keys[:-1])
        if len(twice):
            row = indices[order[twice[0, 0]]].tolist()
            raise BeamboxError(
                f"`indices` must name each site once, got {len(twice)} repeated, first (b, z, y, x) = {row}; "
                "merge the points of a cell before (voxelize does)"
            )
        return cls(sorted_keys, order, shape, batch_size)

    @classmethod
    def trusted(cls, indices: Tensor, shape: Triple, batch_size: int) -> Sites:
        """Return sites from int64 indices (b, z, y, x) that are known to lie inside, none twice: nothing is read."""
        sorted_keys, order = torch.sort(linear_keys(indices, shape))
        sites = cls(sorted_keys, order, shape, batch_size)
        if exporting():  # runtimes that divide in float32 would get them wrong from keys beyond 2^24
            sites.__dict__["indices"] = indices  # where cached_property looks
        return sites

    @classmethod
    def from_keys(cls, keys: Tensor, shape: Triple, batch_size: int) -> Sites:
        """Return sites from ascending linear positions without repeats; trusted."""
        return cls(keys, torch.arange(keys.shape[0], device=keys.device), shape, batch_size)


def linear_keys(indices: Tensor, shape: Triple) -> Tensor:
    """Return ``((b Z + z) Y + y) X + x`` of ``(..., 4)`` int64 indices."""
    b, z, y, x = indices.unbind(dim=-1)
    return ((b * shape[0] + z) * shape[1] + y) * shape[2] + x
