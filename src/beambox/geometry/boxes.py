"""Boxes in the LiDAR frame, and angles.

A box is ``[x, y, z, l, w, h, yaw]``: geometric centre, length along the heading, width across, height; metres and
radians. Yaw 0 points along +x and grows counter-clockwise in BEV. Drawn in ``docs/conventions.md``::

            x forward
            ^        heading of a box with yaw > 0
            |      /
            |     /  yaw
            |    / <-'
    y <-----o            (z up, towards the reader)
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from beambox.geometry.constants import constant

__all__ = [
    "axis_aligned_bev",
    "corners_3d",
    "corners_bev",
    "flip_boxes_x",
    "flip_boxes_y",
    "local_to_world",
    "rotate_boxes",
    "rotate_z",
    "scale_boxes",
    "world_to_local",
    "wrap_angle",
]


def wrap_angle(angle: Tensor, offset: float = 0.5, period: float = 2 * math.pi) -> Tensor:
    """Shift angles by whole periods into ``[-offset * period, (1 - offset) * period)``.

    Args:
        angle: radians, any shape.
        offset: 0.5 centres the interval on zero, 0 starts it at zero.
        period: radians.
    """
    return angle - torch.floor(angle / period + offset) * period


def rotate_z(vectors: Tensor, angle: Tensor) -> Tensor:
    """Rotate about +z, counter-clockwise in BEV.

    Args:
        vectors: ``(..., 2 or more)``; the first two columns are x and y, the others are kept.
        angle: radians, broadcastable to ``vectors.shape[:-1]``.
    """
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    turned = torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)  # (..., 2)
    rest = vectors[..., 2:]
    return torch.cat((turned, rest.expand(*turned.shape[:-1], rest.shape[-1])), dim=-1)


def local_to_world(local: Tensor, boxes: Tensor) -> Tensor:
    """Carry points from each box's own frame (origin at its centre, x along its heading) to the world.

    Args:
        local: ``(N, K, 3)`` metres.
        boxes: ``(N, 7)``.

    Returns:
        ``(N, K, 3)`` metres.
    """
    return rotate_z(local, boxes[:, None, 6]) + boxes[:, None, :3]


def world_to_local(points: Tensor, boxes: Tensor) -> Tensor:
    """Inverse of :func:`local_to_world`: ``(N, K, 3)`` world points into the frames of ``(N, 7)`` boxes."""
    return rotate_z(points - boxes[:, None, :3], -boxes[:, None, 6])


SIGNS = ((1, 1, -1), (-1, 1, -1), (-1, -1, -1), (1, -1, -1), (1, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, 1))
"""On which side of the centre each corner lies, x, y, z, in the order of :func:`corners_3d`."""


def corners_3d(boxes: Tensor) -> Tensor:
    """Return the eight corners of each box.

    Args:
        boxes: ``(N, 7)``.

    Returns:
        ``(N, 8, 3)`` metres: the bottom four counter-clockwise from front-left (front-left, rear-left, rear-right,
        front-right), then the top four in the same order.
    """
    signs = constant(SIGNS, boxes.device, boxes.dtype)
    local = boxes[:, None, 3:6] * signs / 2  # (N, 8, 3)
    return local_to_world(local, boxes)


def corners_bev(boxes: Tensor) -> Tensor:
    """Return the four corners in BEV, counter-clockwise from front-left: ``(N, 7)`` -> ``(N, 4, 2)``."""
    return corners_3d(boxes)[:, :4, :2]


def axis_aligned_bev(boxes: Tensor) -> Tensor:
    """Return the nearest axis-aligned rectangle of each box (length and width swap from 45 degrees on).

    Args:
        boxes: ``(N, 7)``.

    Returns:
        ``(N, 4)`` x_min, y_min, x_max, y_max in metres.
    """
    turned = wrap_angle(boxes[:, 6], 0.5, math.pi).abs() >= math.pi / 4
    extent = torch.where(turned[:, None], boxes[:, [4, 3]], boxes[:, [3, 4]])  # (N, 2)
    return torch.cat((boxes[:, :2] - extent / 2, boxes[:, :2] + extent / 2), dim=1)


def flip_boxes_x(boxes: Tensor) -> Tensor:
    """Mirror across the x axis: ``y -> -y, yaw -> -yaw``."""
    out = boxes.clone()
    out[:, 1] = -boxes[:, 1]
    out[:, 6] = wrap_angle(-boxes[:, 6])
    return out


def flip_boxes_y(boxes: Tensor) -> Tensor:
    """Mirror across the y axis: ``x -> -x, yaw -> pi - yaw``."""
    out = boxes.clone()
    out[:, 0] = -boxes[:, 0]
    out[:, 6] = wrap_angle(math.pi - boxes[:, 6])
    return out


def rotate_boxes(boxes: Tensor, angle: float) -> Tensor:
    """Rotate boxes about the origin's z axis by ``angle`` radians."""
    out = boxes.clone()
    out[:, :3] = rotate_z(boxes[:, :3], boxes.new_tensor(angle))
    out[:, 6] = wrap_angle(boxes[:, 6] + angle)
    return out


def scale_boxes(boxes: Tensor, factor: float) -> Tensor:
    """Scale centres and sizes about the origin."""
    out = boxes.clone()
    out[:, :6] = boxes[:, :6] * factor
    return out
