"""Neighbourhood attention: each pixel attends to the window around it (NAT, Hassani et al. 2023)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_dtype, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose
from beambox.ops.neighborhood import reference

__all__ = ["neighborhood_attention"]


def _numba() -> Callable[..., Tensor]:
    from beambox.ops.neighborhood import cpu

    return cpu.neighborhood_attention


def _triton() -> Callable[..., Tensor]:
    from beambox.ops.neighborhood import gpu

    return gpu.neighborhood_attention


BACKENDS = (
    Backend("triton", can_run_triton, _triton),
    Backend("numba", can_run_numba, _numba),
    Backend("reference", always, lambda: reference.neighborhood_attention),
)


def neighborhood_attention(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int = 7) -> Tensor:
    """Let each pixel attend to the pixels of the window around it.

    ``softmax(q . k / sqrt(d) + bias) . v``, the softmax over the window. At a border the window shifts inside and keeps
    its size, so the pixel is off its centre. The bias belongs to the offset from the pixel to its neighbour: row
    ``r_neighbor - r + window - 1``, column likewise.

    Args:
        q: ``(B, heads, H, W, d)`` queries, floating point.
        k: keys, of the same shape and type.
        v: values, of the same shape and type.
        bias: ``(heads, 2 * window - 1, 2 * window - 1)``; brought to the type of q, which autocast may have changed.
        window: odd edge length in pixels; H and W must not be smaller.

    Returns:
        ``(B, heads, H, W, d)``; differentiable with respect to all four.

    Raises:
        BeamboxError: if a shape or type does not fit, or the map is smaller than the window.
    """
    expect_shape("q", q, (None, None, None, None, None))
    if not q.is_floating_point():
        raise BeamboxError(f"`q` must be floating point, got {str(q.dtype).removeprefix('torch.')}")
    if window < 1 or window % 2 == 0:
        raise BeamboxError(f"`window` must be odd and positive, got {window}")
    height, width = q.shape[2:4]
    if min(height, width) < window:
        raise BeamboxError(
            f"the map must have at least {window} x {window} pixels (the window), got {height} x {width}: pad it with "
            f"zeros on the right and below, and cut the result"
        )
    for name, tensor in (("k", k), ("v", v)):
        expect_shape(name, tensor, q.shape)
        expect_dtype(name, tensor, q.dtype)
    expect_shape("bias", bias, (q.shape[1], 2 * window - 1, 2 * window - 1))
    if q.device.type == "cpu" and q.dtype in (torch.bfloat16, torch.float16):
        # The CPU has no fast version in half precision: float32 is a tenth of the reference's time, and more exact.
        return neighborhood_attention(q.float(), k.float(), v.float(), bias.float(), window).to(q.dtype)
    bias = bias.to(q.dtype)
    return choose("neighborhood_attention", BACKENDS, q, k, v, bias)(q, k, v, bias, window)
