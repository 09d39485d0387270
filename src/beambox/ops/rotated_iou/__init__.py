"""Overlap of rotated boxes, in BEV and in three dimensions."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose, needs_gradient
from beambox.ops.rotated_iou import reference

__all__ = ["intersection_bev", "iou_3d", "iou_bev"]


WITH_GRADIENT = "a box requires a gradient, which the reference alone gives"


def _can_run_numba(a: Tensor, b: Tensor) -> str | None:
    return WITH_GRADIENT if needs_gradient(a, b) else can_run_numba(a, b)


def _can_run_triton(a: Tensor, b: Tensor) -> str | None:
    return WITH_GRADIENT if needs_gradient(a, b) else can_run_triton(a, b)


def _numba_bev() -> Callable[..., Tensor]:
    from beambox.ops.rotated_iou import cpu

    return cpu.iou_bev


def _numba_3d() -> Callable[..., Tensor]:
    from beambox.ops.rotated_iou import cpu

    return cpu.iou_3d


def _numba_area() -> Callable[..., Tensor]:
    from beambox.ops.rotated_iou import cpu

    return cpu.intersection_bev


def _triton_bev() -> Callable[..., Tensor]:
    from beambox.ops.rotated_iou import gpu

    return gpu.iou_bev


def _triton_3d() -> Callable[..., Tensor]:
    from beambox.ops.rotated_iou import gpu

    return gpu.iou_3d


def _triton_area() -> Callable[..., Tensor]:
    from beambox.ops.rotated_iou import gpu

    return gpu.intersection_bev


BEV_BACKENDS = (
    Backend("triton", _can_run_triton, _triton_bev),
    Backend("numba", _can_run_numba, _numba_bev),
    Backend("reference", always, lambda: reference.iou_bev),
)
BOX_BACKENDS = (
    Backend("triton", _can_run_triton, _triton_3d),
    Backend("numba", _can_run_numba, _numba_3d),
    Backend("reference", always, lambda: reference.iou_3d),
)
AREA_BACKENDS = (
    Backend("triton", _can_run_triton, _triton_area),
    Backend("numba", _can_run_numba, _numba_area),
    Backend("reference", always, lambda: reference.intersection_bev),
)


def iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union of all pairs of boxes, in BEV.

    Exact polygon clipping in float64. A box without area, or with a value that is not finite, has IoU 0 with every box.
    Differentiable with respect to both (by the reference version).

    Args:
        a: ``(N, 7)`` boxes x, y, z, l, w, h, yaw; metres and radians; a negative size counts as 0.
        b: ``(M, 7)`` boxes.

    Returns:
        ``(N, M)`` in [0, 1], of the boxes' type.

    Raises:
        BeamboxError: if the boxes do not have seven columns or are not floating point.
    """
    _check(a, b)
    return choose("iou_bev", BEV_BACKENDS, a, b)(a, b)


def iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """Return the intersection over union of the volumes of all pairs of boxes; arguments as in :func:`iou_bev`."""
    _check(a, b)
    return choose("iou_3d", BOX_BACKENDS, a, b)(a, b)


def intersection_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the area in square metres shared by all pairs, in BEV; arguments as in :func:`iou_bev`."""
    _check(a, b)
    return choose("intersection_bev", AREA_BACKENDS, a, b)(a, b)


def _check(a: Tensor, b: Tensor) -> None:
    for name, boxes in (("a", a), ("b", b)):
        expect_shape(name, boxes, (None, 7))
        if not boxes.is_floating_point():
            raise BeamboxError(f"`{name}` must be floating point, got {str(boxes.dtype).removeprefix('torch.')}")
