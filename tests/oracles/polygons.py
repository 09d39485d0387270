"""Overlap of rotated boxes by shapely, an independent polygon library."""

from __future__ import annotations

import numpy as np
import shapely


def rectangles(boxes: np.ndarray) -> np.ndarray:
    """Return the shapely polygon of each (N, 7) box in BEV."""
    x, y, _, length, width, _, yaw = boxes.astype(np.float64).T
    along = np.stack((np.cos(yaw), np.sin(yaw)), axis=1) * (length / 2)[:, None]
    across = np.stack((-np.sin(yaw), np.cos(yaw)), axis=1) * (width / 2)[:, None]
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    corners = np.stack((x, y), axis=1)[:, None] + signs[:, :1] * along[:, None] + signs[:, 1:] * across[:, None]
    return shapely.polygons(corners)


def paired_intersection(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the area shared by each row of a with the same row of b, in BEV."""
    return shapely.area(shapely.intersection(rectangles(a), rectangles(b)))


def paired_iou_bev(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the bird's-eye-view IoU of each row of a with the same row of b; 0 where both are flat."""
    shared = paired_intersection(a, b)
    union = a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def paired_iou_3d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the 3-D IoU of each row of a with the same row of b; 0 where both are flat."""
    top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    shared = paired_intersection(a, b) * np.maximum(top - bottom, 0)
    union = a[:, 3:6].prod(axis=1) + b[:, 3:6].prod(axis=1) - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
