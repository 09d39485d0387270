"""Box codes: what an anchor head regresses, and headings (SECOND, section 3.2; KASSD, equation 6)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from beambox.geometry.boxes import wrap_angle

__all__ = ["DIRECTION_OFFSET", "decode_boxes", "direction_bin", "encode_boxes", "resolve_heading"]

DIRECTION_OFFSET = 0.78539
"""Radians by which the two heading bins are turned, so that no common heading lies on their border."""
LARGEST_GROWTH = math.log(1000)
"""Sizes are decoded to at most a thousand anchors: a network that is hardly trained may ask for e^100 and more."""


def encode_boxes(boxes: Tensor, anchors: Tensor) -> Tensor:
    """Express boxes relative to anchors.

    ``t = [(x - xa) / d, (y - ya) / d, (z - za) / ha, ln(l / la), ln(w / wa), ln(h / ha), yaw - yaw_a]`` with
    ``d = sqrt(la^2 + wa^2)``.

    Args:
        boxes: ``(..., 7)``.
        anchors: ``(..., 7)``, broadcastable to ``boxes``.

    Returns:
        ``(..., 7)`` codes, without unit but for the last (radians).
    """
    diagonal = torch.linalg.vector_norm(anchors[..., 3:5], dim=-1, keepdim=True)
    height = anchors[..., 5:6]
    reach = torch.cat((diagonal, diagonal, height), dim=-1)  # (..., 3)
    center = (boxes[..., :3] - anchors[..., :3]) / reach
    size = torch.log(boxes[..., 3:6].clamp(min=1e-5) / anchors[..., 3:6].clamp(min=1e-5))
    return torch.cat((center, size, boxes[..., 6:7] - anchors[..., 6:7]), dim=-1)


def decode_boxes(deltas: Tensor, anchors: Tensor) -> Tensor:
    """Inverse of :func:`encode_boxes`; headings are known up to half a turn until :func:`resolve_heading`.

    Sizes stay finite whatever the codes: they grow to at most a thousand times the anchor's.
    """
    diagonal = torch.linalg.vector_norm(anchors[..., 3:5], dim=-1, keepdim=True)
    reach = torch.cat((diagonal, diagonal, anchors[..., 5:6]), dim=-1)
    center = deltas[..., :3] * reach + anchors[..., :3]
    size = torch.exp(deltas[..., 3:6].clamp(max=LARGEST_GROWTH)) * anchors[..., 3:6]
    return torch.cat((center, size, deltas[..., 6:7] + anchors[..., 6:7]), dim=-1)


def direction_bin(yaw: Tensor) -> Tensor:
    """Tell in which of the two half turns a heading lies: radians -> int64 in {0, 1}."""
    turned = wrap_angle(yaw - DIRECTION_OFFSET, 0.0, 2 * math.pi)
    return torch.floor(turned / math.pi).long().clamp(0, 1)


def resolve_heading(yaw: Tensor, bins: Tensor) -> Tensor:
    """Turn headings known up to half a turn into the half turn that was classified.

    Args:
        yaw: radians, any shape.
        bins: the same shape, values 0 and 1.

    Returns:
        Radians in [-pi, pi).
    """
    half = wrap_angle(yaw - DIRECTION_OFFSET, 0.0, math.pi) + DIRECTION_OFFSET
    return wrap_angle(half + math.pi * bins.to(yaw.dtype))
