"""Sparse 3-D convolution: submanifold, strided and inverse, for training and inference on any device."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_graph, can_run_numba, can_run_triton, choose, pinned
from beambox.ops.sparse_conv import reference
from beambox.ops.sparse_conv.sites import ConvSpec, KernelMap, Sites, Triple, linear_keys
from beambox.ops.sparse_conv.tensor import SparseTensor

__all__ = [
    "ConvSpec",
    "KernelMap",
    "Sites",
    "SparseTensor",
    "Triple",
    "find_chain",
    "inverse_conv3d",
    "kernel_map",
    "linear_keys",
    "sparse_conv3d",
    "submanifold_conv3d",
]


MOST_CELLS = 1 << 31
"""Bytes of the map of a level on a GPU; beyond, its sites are found by sorting."""


def _can_run_numba(*tensors: Tensor) -> str | None:
    """Return why the CPU version cannot run; unlike other operations it takes half precision too."""
    half = (torch.bfloat16, torch.float16)
    return can_run_numba(*(t for t in tensors if t.dtype not in half or t.device.type != "cpu"))


def _can_run_triton(*tensors: Tensor) -> str | None:
    """Return why Triton cannot run; its matrix products have no float64 everywhere."""
    reason = can_run_triton(*tensors)
    if reason is None and any(t.dtype == torch.float64 for t in tensors):
        return "a tensor is float64, the Triton version takes float32, float16 or bfloat16"
    return reason


def _triton() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.gpu import convolve

    return convolve


def _numba() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.cpu import convolve

    return convolve


def _numba_targets() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.cpu_maps import find_targets

    return find_targets


def _triton_targets() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.gpu_maps import find_levels

    def find_targets(sites: Sites, spec: ConvSpec) -> Tensor:
        if not _maps_fit(sites, (spec,)):
            return reference.find_targets(sites, spec)
        return find_levels(sites, (spec,))[0].sorted_keys

    return find_targets


def _graph() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.graph import convolve

    return convolve


def _graph_targets() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.graph_maps import find_targets

    return find_targets


BACKENDS = (
    Backend("graph", can_run_graph, _graph),
    Backend("triton", _can_run_triton, _triton),
    Backend("numba", _can_run_numba, _numba),
    Backend("reference", always, lambda: reference.convolve),
)
TARGET_BACKENDS = (
    Backend("graph", can_run_graph, _graph_targets),
    Backend("triton", can_run_triton, _triton_targets),
    Backend("numba", can_run_numba, _numba_targets),
    Backend("reference", always, lambda: reference.find_targets),
)


def kernel_map(sites: Sites, spec: ConvSpec) -> KernelMap:
    """Return the map of a convolution from these sites, found once and kept with them."""
    known = sites.maps.get(spec)
    if known is not None:
        return known
    if spec.submanifold:
        target = sites
    else:
        keys = choose("find_targets", TARGET_BACKENDS, sites.sorted_keys)(sites, spec)
        target = Sites.from_keys(keys, spec.output_shape(sites.shape), sites.batch_size)
    found = KernelMap(sites, target, spec)
    sites.maps[spec] = found
    return found


def find_chain(sites: Sites, specs: Sequence[ConvSpec]) -> None:
    """Find the sites of a chain of strided convolutions together, where finding each by itself would wait for a GPU.

    They are kept with the sites they start from, as :func:`kernel_map` keeps them; elsewhere nothing is done.
    """
    one_by_one = can_run_triton(sites.sorted_keys) is not None or pinned() not in (None, "triton")
    if one_by_one or not _maps_fit(sites, specs) or specs[0] in sites.maps:
        return
    from beambox.ops.sparse_conv.gpu_maps import find_levels

    for spec, target in zip(specs, find_levels(sites, specs), strict=True):
        sites.maps[spec] = KernelMap(sites, target, spec)
        sites = target


def _maps_fit(sites: Sites, specs: Sequence[ConvSpec]) -> bool:
    """Tell whether a byte for every cell of the levels is not too much."""
    shape = sites.shape
    for spec in specs:
        shape = spec.output_shape(shape)
        if sites.batch_size * math.prod(shape) > MOST_CELLS:
            return False
    return True


def submanifold_conv3d(
    x: SparseTensor, weight: Tensor, bias: Tensor | None = None, dilation: Triple = (1, 1, 1)
) -> SparseTensor:
    """Convolve at the active sites only, which stay as they are.

    Args:
        x: the input.
        weight: ``(kz, ky, kx, C_in, C_out)``, sizes odd.
        bias: ``(C_out,)`` or None.
        dilation: (z, y, x).

    Returns:
        A tensor at the sites of ``x`` equal to a dense convolution with "same" padding read at these sites.
    """
    _check_weight(x, weight)
    found = kernel_map(x.sites, ConvSpec.centered(_kernel(weight), dilation))
    return SparseTensor(_convolve(x.features, weight, bias, found), found.target)


def sparse_conv3d(
    x: SparseTensor,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: Triple = (1, 1, 1),
    padding: Triple = (0, 0, 0),
    dilation: Triple = (1, 1, 1),
) -> SparseTensor:
    """Convolve, activating every output whose receptive field holds an active input.

    Args:
        x: the input.
        weight: ``(kz, ky, kx, C_in, C_out)``.
        bias: ``(C_out,)`` or None; added at active outputs only.
        stride: (z, y, x).
        padding: (z, y, x).
        dilation: (z, y, x).

    Returns:
        A tensor whose sites ascend in (b, z, y, x).
    """
    _check_weight(x, weight)
    found = kernel_map(x.sites, ConvSpec(_kernel(weight), stride, padding, dilation))
    return SparseTensor(_convolve(x.features, weight, bias, found), found.target)


def inverse_conv3d(
    x: SparseTensor,
    weight: Tensor,
    onto: Sites,
    bias: Tensor | None = None,
    stride: Triple = (1, 1, 1),
    padding: Triple = (0, 0, 0),
    dilation: Triple = (1, 1, 1),
) -> SparseTensor:
    """Carry features back through a strided convolution onto the sites it came from.

    Equal to a dense transposed convolution read at the sites ``onto``.

    Args:
        x: the output of ``sparse_conv3d`` with this kernel, stride, padding and dilation on a tensor at ``onto``,
            perhaps after submanifold layers.
        weight: ``(kz, ky, kx, C_in, C_out)``.
        onto: sites of the strided convolution's input.
        bias: ``(C_out,)`` or None.
        stride: (z, y, x) of the strided convolution.
        padding: (z, y, x) of the strided convolution.
        dilation: (z, y, x) of the strided convolution.

    Raises:
        BeamboxError: if ``x`` does not stand where that convolution would have put it.
    """
    _check_weight(x, weight)
    found = kernel_map(onto, ConvSpec(_kernel(weight), stride, padding, dilation))
    same = found.target is x.sites or (found.target.shape == x.shape and found.target.indices.equal(x.indices))
    if not same:
        raise BeamboxError(
            f"`x` must stand at the {len(found.target)} sites of {found.target.shape} that this convolution makes of "
            f"`onto`, got {len(x.sites)} sites of {x.shape}; give the same kernel, stride, padding and dilation"
        )
    return SparseTensor(_convolve(x.features, weight, bias, found.inverse), onto)


def _kernel(weight: Tensor) -> Triple:
    kz, ky, kx = weight.shape[:3]
    return kz, ky, kx


def _check_weight(x: SparseTensor, weight: Tensor) -> None:
    expect_shape("weight", weight, ("kz", "ky", "kx", x.channels, "C_out"))


def _convolve(features: Tensor, weight: Tensor, bias: Tensor | None, pairs: KernelMap) -> Tensor:
    dtype = _working_type(features)
    features, weight = features.to(dtype), weight.flatten(0, 2).to(dtype)
    bias = None if bias is None else bias.to(dtype)
    tensors = (features, weight) if bias is None else (features, weight, bias)
    return choose("sparse_conv", BACKENDS, *tensors)(features, weight, bias, pairs)


def _working_type(features: Tensor) -> torch.dtype:
    """Return autocast's type where it is on, except on processors where it would not pay."""
    kind = features.device.type
    if not torch.is_autocast_enabled(kind):
        return features.dtype
    if kind == "cpu" and not torch.cpu._is_amx_tile_supported():
        return torch.promote_types(features.dtype, torch.float32)
    return torch.get_autocast_dtype(kind)
