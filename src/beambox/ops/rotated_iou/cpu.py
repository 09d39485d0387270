"""Overlap of rotated boxes, one pair at a time, after cheap tests that tell most pairs apart (numba)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from beambox.ops.jit import jit
from beambox.ops.rotated_iou.prepared import prepare

__all__ = ["intersection_bev", "iou_3d", "iou_bev", "shared_area"]

AREA, IOU_BEV, IOU_3D = 0, 1, 2


def iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the bird's-eye-view IoU of all pairs; see :func:`beambox.ops.rotated_iou.iou_bev`."""
    return _pairs(a, b, IOU_BEV)


def iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """Return the 3-D IoU of all pairs; see :func:`beambox.ops.rotated_iou.iou_3d`."""
    return _pairs(a, b, IOU_3D)


def intersection_bev(a: Tensor, b: Tensor) -> Tensor:
    """Return the shared area of all pairs; see :func:`beambox.ops.rotated_iou.intersection_bev`."""
    return _pairs(a, b, AREA)


def _pairs(a: Tensor, b: Tensor, what: int) -> Tensor:
    dtype = torch.promote_types(a.dtype, b.dtype)
    return torch.from_numpy(_fill(prepare(a).numpy(), prepare(b).numpy(), what)).to(dtype)


@jit
def _fill(a, b, what):
    """Return area, BEV IoU or 3-D IoU of all pairs of prepared boxes: (N, M) float64."""
    out = np.zeros((len(a), len(b)))
    scratch = np.empty((4, 16))
    for i in range(len(a)):
        for j in range(len(b)):
            dx, dy, reach = b[j, 0] - a[i, 0], b[j, 1] - a[i, 1], a[i, 6] + b[j, 6]
            if not dx * dx + dy * dy <= reach * reach:
                continue  # most pairs: their circumscribed circles do not meet
            shared = shared_area(a[i], b[j], scratch)
            if not shared > 0:
                continue
            size_a, size_b = 4 * a[i, 2] * a[i, 3], 4 * b[j, 2] * b[j, 3]
            if what == AREA:
                out[i, j] = shared
                continue
            if what == IOU_3D:
                top = min(a[i, 7] + a[i, 8], b[j, 7] + b[j, 8])
                bottom = max(a[i, 7] - a[i, 8], b[j, 7] - b[j, 8])
                shared *= max(0.0, top - bottom)
                size_a *= 2 * a[i, 8]
                size_b *= 2 * b[j, 8]
            union = size_a + size_b - shared
            if union > 0:
                out[i, j] = min(1.0, shared / union)
    return out


@jit
def shared_area(a, b, scratch):
    """Return the area shared by two prepared, finite boxes; ``scratch`` is (4, 16) float64 of any content."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    cos, sin = a[4] * b[4] + a[5] * b[5], a[4] * b[5] - a[5] * b[4]  # of the angle from a to b
    along, across = a[4] * dx + a[5] * dy, a[4] * dy - a[5] * dx  # b's centre in a's frame
    if abs(along) > a[2] + abs(cos) * b[2] + abs(sin) * b[3]:
        return 0.0
    if abs(across) > a[3] + abs(sin) * b[2] + abs(cos) * b[3]:
        return 0.0
    if abs(b[4] * dx + b[5] * dy) > b[2] + abs(cos) * a[2] + abs(sin) * a[3]:
        return 0.0
    if abs(b[4] * dy - b[5] * dx) > b[3] + abs(sin) * a[2] + abs(cos) * a[3]:
        return 0.0

    x, y, next_x, next_y = scratch[0], scratch[1], scratch[2], scratch[3]
    lx, ly, wx, wy = cos * b[2], sin * b[2], -sin * b[3], cos * b[3]
    x[0], y[0] = along + lx + wx, across + ly + wy
    x[1], y[1] = along - lx + wx, across - ly + wy
    x[2], y[2] = along - lx - wx, across - ly - wy
    x[3], y[3] = along + lx - wx, across + ly - wy
    n = _clip(x, y, 4, a[2], next_x, next_y)
    n = _clip(next_x, next_y, n, a[3], x, y)
    n = _clip(x, y, n, a[2], next_x, next_y)
    n = _clip(next_x, next_y, n, a[3], x, y)
    doubled = 0.0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        doubled += x[i] * y[j] - y[i] * x[j]
    return max(0.0, doubled / 2)


@jit
def _clip(x, y, n, limit, out_x, out_y):
    """Keep the part of a convex polygon where x <= limit, then turn it by a quarter circle, clockwise.

    Convex, it gains one corner a cut at most, so eight suffice; whatever the corners, no more than 16 are written.
    """
    kept = 0
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        if x[i] <= limit and kept < 16:
            out_x[kept], out_y[kept] = y[i], -x[i]
            kept += 1
        if (x[i] <= limit) != (x[j] <= limit) and kept < 16:
            out_x[kept] = y[i] + (limit - x[i]) / (x[j] - x[i]) * (y[j] - y[i])
            out_y[kept] = -limit
            kept += 1
    return kept
