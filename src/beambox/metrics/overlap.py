"""Overlaps of ground truth and detections, frame by frame, laid out for :mod:`beambox.metrics.matching`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.ops.rotated_iou import intersection_bev

__all__ = ["covered_share", "image_overlap", "rotated_overlaps", "starts"]

Floats = NDArray[np.float64]


def starts(lengths: Sequence[int]) -> NDArray[np.int64]:
    """Return where each of several runs begins, and the end: ``(F,)`` lengths -> ``(F + 1,)``."""
    return np.concatenate(([0], np.cumsum(np.asarray(lengths, dtype=np.int64)))).astype(np.int64)


def _image_intersection(a: Floats, b: Floats) -> Floats:
    width = np.minimum(a[:, None, 2], b[None, :, 2]) - np.maximum(a[:, None, 0], b[None, :, 0])
    height = np.minimum(a[:, None, 3], b[None, :, 3]) - np.maximum(a[:, None, 1], b[None, :, 1])
    return np.where((width > 0) & (height > 0), width * height, 0.0)  # (N, M)


def _image_area(boxes: Floats) -> Floats:
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


def _divide(part: Floats, whole: Floats) -> Floats:
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)


def image_overlap(a: Floats, b: Floats) -> Floats:
    """Return the IoU of image boxes ``(N, 4)`` and ``(M, 4)`` left, top, right, bottom: ``(N, M)``."""
    shared = _image_intersection(a, b)
    return _divide(shared, _image_area(a)[:, None] + _image_area(b)[None] - shared)


def covered_share(boxes: Floats, regions: Floats) -> Floats:
    """Return the largest share of each image box ``(N, 4)`` that one of the regions ``(K, 4)`` covers: ``(N,)``."""
    if not len(regions):
        return np.zeros(len(boxes))
    shared = _image_intersection(boxes, regions)
    return _divide(shared, np.repeat(_image_area(boxes)[:, None], len(regions), axis=1)).max(axis=1)


def rotated_overlaps(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return the IoU in BEV and in 3-D.

    Args:
        a: ``(N, 7)`` boxes x, y, z, l, w, h, yaw; metres, radians.
        b: ``(M, 7)``.

    Returns:
        ``(N, M)`` in BEV, ``(N, M)`` in 3-D.
    """
    if not len(a) or not len(b):
        return np.zeros((len(a), len(b))), np.zeros((len(a), len(b)))
    shared = intersection_bev(torch.from_numpy(a), torch.from_numpy(b)).double().numpy()  # (N, M) square metres
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    top = np.minimum((a[:, 2] + a[:, 5] / 2)[:, None], (b[:, 2] + b[:, 5] / 2)[None])
    bottom = np.maximum((a[:, 2] - a[:, 5] / 2)[:, None], (b[:, 2] - b[:, 5] / 2)[None])
    volume = shared * np.maximum(top - bottom, 0.0)
    seen_from_above = _divide(shared, area_a[:, None] + area_b[None] - shared)
    return seen_from_above, _divide(volume, (area_a * a[:, 5])[:, None] + (area_b * b[:, 5])[None] - volume)
