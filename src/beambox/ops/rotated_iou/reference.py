"""Overlap of rotated boxes in plain PyTorch: the definition.

Two rectangles meet in a convex polygon. In the frame of the first one, the second one's corners are clipped by the four
half-planes ``x <= l/2, -x <= l/2, y <= w/2, -y <= w/2`` in turn (Sutherland and Hodgman, 1974); the shoelace formula
gives the area. Everything is float64 and relative to the first box's centre, so that far-away boxes lose nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["intersection_bev", "iou_3d", "iou_bev", "paired_intersection_bev"]

PAIRS_AT_ONCE = 1 << 18  # bounds the memory of the clipping


def iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the bird's-eye-view IoU of all pairs; see :func:`beambox.ops.rotated_iou.iou_bev`."""
    shared = intersection_bev(a.double(), b.double())  # (N, M)
    area_a, area_b = (box[:, 3:5].double().clamp(min=0).prod(dim=1) for box in (a, b))
    return _ratio(shared, area_a[:, None] + area_b - shared).to(torch.promote_types(a.dtype, b.dtype))


def iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """Return the 3-D IoU of all pairs; see :func:`beambox.ops.rotated_iou.iou_3d`."""
    dtype = torch.promote_types(a.dtype, b.dtype)
    a, b = a.double(), b.double()
    half_a, half_b = a[:, None, 5].clamp(min=0) / 2, b[:, 5].clamp(min=0) / 2
    top = torch.minimum(a[:, None, 2] + half_a, b[:, 2] + half_b)  # (N, M)
    bottom = torch.maximum(a[:, None, 2] - half_a, b[:, 2] - half_b)
    shared = intersection_bev(a, b) * (top - bottom).clamp(min=0)
    volume_a, volume_b = (box[:, 3:6].clamp(min=0).prod(dim=1) for box in (a, b))
    return _ratio(shared, volume_a[:, None] + volume_b - shared).to(dtype)


def intersection_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the shared area of all pairs; see :func:`beambox.ops.rotated_iou.intersection_bev`."""
    dtype = torch.promote_types(a.dtype, b.dtype)
    a, b = a.double(), b.double()
    with torch.no_grad():  # boxes whose circumscribed circles do not meet share nothing
        reach_a, reach_b = (box[:, 3:5].clamp(min=0).norm(dim=1) / 2 for box in (a, b))
        gap = torch.cdist(a[:, :2], b[:, :2], compute_mode="donot_use_mm_for_euclid_dist")  # (N, M)
        finite_a, finite_b = (box.isfinite().all(dim=1) for box in (a, b))
        near = (gap <= reach_a[:, None] + reach_b) & finite_a[:, None] & finite_b
        first, second = near.nonzero(as_tuple=True)  # (P,)
    blocks = zip(first.split(PAIRS_AT_ONCE), second.split(PAIRS_AT_ONCE))
    areas = torch.cat([paired_intersection_bev(a[i], b[j]) for i, j in blocks])  # (P,)
    return a.new_zeros(len(a), len(b)).index_put((first, second), areas).to(dtype)


def paired_intersection_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the shared area of each box of ``a`` with the box of ``b`` in the same row: two ``(P, 7)`` -> ``(P,)``."""
    length, width = a[:, 3].clamp(min=0), a[:, 4].clamp(min=0)
    x, y = _corners_in_frame(a, b)  # (P, 4) each
    x, y = _clip(x, y, length[:, None] / 2)  # x <= l/2
    x, y = _clip(-x, -y, length[:, None] / 2)  # -x <= l/2, turned by a half circle
    x, y = _clip(-y, x, width[:, None] / 2)  # turned by a quarter circle, twice more
    x, y = _clip(-x, -y, width[:, None] / 2)
    doubled = x * y.roll(-1, dims=1) - y * x.roll(-1, dims=1)  # shoelace
    return doubled.sum(dim=1).clamp(min=0) / 2


def _corners_in_frame(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and y, ``(P, 4)`` each, of the corners of ``b`` in the frames of ``a``, counter-clockwise."""
    cos, sin = a[:, 6].cos(), a[:, 6].sin()
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    turn = b[:, 6] - a[:, 6]
    along = b[:, 3].clamp(min=0)[:, None] / 2 * b.new_tensor([1.0, -1.0, -1.0, 1.0])  # (P, 4)
    across = b[:, 4].clamp(min=0)[:, None] / 2 * b.new_tensor([1.0, 1.0, -1.0, -1.0])
    x = (cos * dx + sin * dy)[:, None] + turn.cos()[:, None] * along - turn.sin()[:, None] * across
    y = (cos * dy - sin * dx)[:, None] + turn.sin()[:, None] * along + turn.cos()[:, None] * across
    return x, y


def _clip(x: Tensor, y: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Keep the part of convex polygons where ``x <= limit``.

    Args:
        x: ``(P, V)`` corners in order; a corner may stand several times.
        y: ``(P, V)``.
        limit: ``(P, 1)``.

    Returns:
        x and y, ``(P, V + 1)`` each; unused places repeat the first corner, all are zero where nothing remains.
    """
    next_x, next_y = x.roll(-1, dims=1), y.roll(-1, dims=1)
    inside, next_inside = x <= limit, next_x <= limit
    crosses = inside != next_inside
    step = torch.where(crosses, next_x - x, 1.0)  # 1 where unused keeps gradients finite
    cross_y = y + (limit - x) / step * (next_y - y)
    all_x = torch.stack((x, limit.expand_as(x)), dim=2).flatten(1)  # (P, 2 V): corner, crossing, corner, ...
    all_y = torch.stack((y, cross_y), dim=2).flatten(1)
    used = torch.stack((inside, crosses), dim=2).flatten(1)
    # Cutting a convex polygon adds one corner at most: move the used places to the front, keep V + 1 of them.
    order = (~used).to(torch.uint8).argsort(dim=1, stable=True)[:, : x.shape[1] + 1]
    used = used.gather(1, order)
    first = order[:, :1].expand_as(order)
    order = torch.where(used, order, first)
    some = used[:, :1]
    return torch.where(some, all_x.gather(1, order), 0.0), torch.where(some, all_y.gather(1, order), 0.0)


def _ratio(shared: Tensor, union: Tensor) -> Tensor:
    """Divide, giving 0 where both boxes are flat and at most 1."""
    positive = union > 0
    return torch.where(positive, shared / torch.where(positive, union, 1.0), 0.0).clamp(max=1)
