"""Overlap of rotated boxes on a GPU (Triton), without lists of corners.

In the frame of the first box, a rectangle ``|x| <= L, |y| <= W``, the shared area is the integral over x, from -L to L,
of how far the second box's upper border, held within [-W, W], lies above its lower border, held likewise. Along each of
the four edges that border is linear in x, so each adds a trapezium: its extent in x, cut to [-L, L], times the mean of
y, held within [-W, W]. Edges walked towards -x (the upper border, counter-clockwise) count positive, the others
negative. No case distinctions, no ill-conditioned crossings; the same number as clipping gives.
"""

# Triton turns a number given for a tl.constexpr into a constant, which type checkers do not know:
# pyright: reportArgumentType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.ops.rotated_iou.prepared import prepare

__all__ = ["intersection_bev", "iou_3d", "iou_bev", "shared_area"]

AREA, IOU_BEV, IOU_3D = 0, 1, 2
TILE = 32


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
    out = torch.zeros(len(a), len(b), dtype=torch.float64, device=a.device)
    if out.numel():
        grid = (triton.cdiv(len(a), TILE), triton.cdiv(len(b), TILE))
        _fill[grid](prepare(a), prepare(b), out, len(a), len(b), what, TILE)
    return out.to(torch.promote_types(a.dtype, b.dtype))


@triton.jit
def _fill(a, b, out, n, m, what: tl.constexpr, tile: tl.constexpr):
    """Write area, BEV IoU or 3-D IoU of one tile of pairs of prepared boxes."""
    i = (tl.program_id(0) * tile + tl.arange(0, tile))[:, None]  # (tile, 1)
    j = (tl.program_id(1) * tile + tl.arange(0, tile))[None, :]  # (1, tile)
    shared = shared_area(a, i, i < n, b, j, j < m)  # (tile, tile)
    size_a = 4 * tl.load(a + i * 9 + 2, i < n, 0.0) * tl.load(a + i * 9 + 3, i < n, 0.0)
    size_b = 4 * tl.load(b + j * 9 + 2, j < m, 0.0) * tl.load(b + j * 9 + 3, j < m, 0.0)
    if what == 2:
        z_a, tall_a = tl.load(a + i * 9 + 7, i < n, 0.0), tl.load(a + i * 9 + 8, i < n, 0.0)
        z_b, tall_b = tl.load(b + j * 9 + 7, j < m, 0.0), tl.load(b + j * 9 + 8, j < m, 0.0)
        top, bottom = tl.minimum(z_a + tall_a, z_b + tall_b), tl.maximum(z_a - tall_a, z_b - tall_b)
        shared = shared * tl.maximum(top - bottom, 0.0)
        size_a, size_b = size_a * 2 * tall_a, size_b * 2 * tall_b
    if what != 0:
        union = size_a + size_b - shared
        shared = tl.where(union > 0, tl.minimum(shared / tl.where(union > 0, union, 1.0), 1.0), 0.0)
    tl.store(out + i * m + j, shared, (i < n) & (j < m))


@triton.jit
def shared_area(a, i, has_i, b, j, has_j):
    """Return the areas shared by rows ``i`` (T, 1) of prepared boxes ``a`` and rows ``j`` (1, U) of ``b``: (T, U)."""
    x_a, y_a = tl.load(a + i * 9, has_i, 0.0), tl.load(a + i * 9 + 1, has_i, 0.0)
    long, wide = tl.load(a + i * 9 + 2, has_i, 0.0), tl.load(a + i * 9 + 3, has_i, 0.0)
    cos_a, sin_a = tl.load(a + i * 9 + 4, has_i, 0.0), tl.load(a + i * 9 + 5, has_i, 0.0)
    x_b, y_b = tl.load(b + j * 9, has_j, 0.0), tl.load(b + j * 9 + 1, has_j, 0.0)
    long_b, wide_b = tl.load(b + j * 9 + 2, has_j, 0.0), tl.load(b + j * 9 + 3, has_j, 0.0)
    cos_b, sin_b = tl.load(b + j * 9 + 4, has_j, 0.0), tl.load(b + j * 9 + 5, has_j, 0.0)

    dx, dy = x_b - x_a, y_b - y_a
    cos, sin = cos_a * cos_b + sin_a * sin_b, cos_a * sin_b - sin_a * cos_b
    x, y = cos_a * dx + sin_a * dy, cos_a * dy - sin_a * dx  # b's centre in a's frame
    lx, ly, wx, wy = cos * long_b, sin * long_b, -sin * wide_b, cos * wide_b
    # Corners counter-clockwise: front-left, rear-left, rear-right, front-right.
    area = _under(x + lx + wx, y + ly + wy, x - lx + wx, y - ly + wy, long, wide)
    area += _under(x - lx + wx, y - ly + wy, x - lx - wx, y - ly - wy, long, wide)
    area += _under(x - lx - wx, y - ly - wy, x + lx - wx, y + ly - wy, long, wide)
    area += _under(x + lx - wx, y + ly - wy, x + lx + wx, y + ly + wy, long, wide)
    return tl.where(area > 0, area, 0.0)  # NaN boxes share nothing


@triton.jit
def _under(x0, y0, x1, y1, long, wide):
    """Return the integral of y held within [-wide, wide], along an edge cut to |x| <= long, counted towards -x."""
    run = tl.where(x1 == x0, 1.0, x1 - x0)
    c0, c1 = tl.minimum(tl.maximum(x0, -long), long), tl.minimum(tl.maximum(x1, -long), long)
    steep = (y1 - y0) / run
    s0, s1 = y0 + (c0 - x0) * steep, y0 + (c1 - x0) * steep  # y where the edge is cut
    low, high = tl.minimum(s0, s1), tl.maximum(s0, s1)
    below = tl.maximum(tl.minimum(high, -wide) - low, 0.0)  # lengths in y of the parts below, within and above
    above = tl.maximum(high - tl.maximum(low, wide), 0.0)
    h0, h1 = tl.minimum(tl.maximum(low, -wide), wide), tl.minimum(tl.maximum(high, -wide), wide)
    whole = below + above + (h1 - h0)
    mean = (wide * (above - below) + (h1 - h0) * (h0 + h1) / 2) / tl.where(whole > 0, whole, 1.0)
    mean = tl.where(whole > 0, mean, h0)
    return (c0 - c1) * mean
