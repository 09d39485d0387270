"""Which points lie in which boxes."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from beambox.checks import BeamboxError, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_numba, choose
from beambox.ops.points_in_boxes import reference

__all__ = ["points_in_boxes", "points_in_boxes_mask"]


def _numba_owner() -> Callable[..., Tensor]:
    from beambox.ops.points_in_boxes import cpu

    return cpu.points_in_boxes


def _numba_mask() -> Callable[..., Tensor]:
    from beambox.ops.points_in_boxes import cpu

    return cpu.points_in_boxes_mask


OWNER_BACKENDS = (
    Backend("numba", can_run_numba, _numba_owner),
    Backend("reference", always, lambda: reference.points_in_boxes),
)
MASK_BACKENDS = (
    Backend("numba", can_run_numba, _numba_mask),
    Backend("reference", always, lambda: reference.points_in_boxes_mask),
)


def points_in_boxes(points: Tensor, boxes: Tensor) -> Tensor:
    """Find the first box that contains each point.

    Faces belong to the box (within a nanometre, computed in float64). A point with a NaN coordinate is in no box.

    Args:
        points: ``(N, 3 or more)``; x, y, z in metres, further columns are ignored.
        boxes: ``(M, 7)`` x, y, z, l, w, h, yaw; metres and radians.

    Returns:
        ``(N,)`` int64 row of the first box that contains the point, or -1.

    Raises:
        BeamboxError: if a shape does not fit.
    """
    _check(points, boxes)
    return choose("points_in_boxes", OWNER_BACKENDS, points, boxes)(points.detach(), boxes.detach())


def points_in_boxes_mask(points: Tensor, boxes: Tensor) -> Tensor:
    """Tell for all pairs whether the box contains the point: ``(M, N)`` bool; see :func:`points_in_boxes`."""
    _check(points, boxes)
    return choose("points_in_boxes_mask", MASK_BACKENDS, points, boxes)(points.detach(), boxes.detach())


def _check(points: Tensor, boxes: Tensor) -> None:
    expect_shape("points", points, (None, None))
    if points.shape[1] < 3:
        raise BeamboxError(f"`points` must have at least 3 columns x, y, z, got {points.shape[1]}")
    expect_shape("boxes", boxes, (None, 7))
