"""The road as a plane, fitted to the points of a sweep."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = ["fit_road_plane"]

CELL = 2.0
"""Edge of the cells whose lowest points stand for the ground, metres."""
REACH = 40.0
"""Points farther away than this do not vote, metres."""
FEWEST_CELLS = 12
"""Fewer cells than this do not make a plane."""
WIDTHS = (1.0, 0.5, 0.3, 0.2, 0.15, 0.15)
"""Distance at which a cell loses all its say, one entry a round of the fit, metres."""


def fit_road_plane(points: Tensor) -> Tensor | None:
    """Fit a plane to the ground of a sweep.

    The low point of every 2 m cell within 40 m votes; a plane is fitted to them by least squares, reweighted with
    Tukey's biweight of shrinking width, so that cars, walls and stray returns below the ground lose their say.

    Args:
        points: ``(N, 3 or more)`` x, y, z in metres, z up.

    Returns:
        ``(4,)`` float32 a, b, c, d with ax + by + cz + d = 0, unit normal pointing up; None where too few
        points lie near.
    """
    xyz = points[:, :3].numpy()
    near = np.flatnonzero((np.abs(xyz[:, 0]) < REACH) & (np.abs(xyz[:, 1]) < REACH))
    if len(near) == 0:
        return None
    xyz = xyz[near]
    side = int(2 * REACH / CELL)
    cells = np.floor((xyz[:, :2] + REACH) / CELL).astype(np.int64).clip(0, side - 1)
    lowest = np.full(side * side, np.inf, dtype=np.float32)
    np.minimum.at(lowest, cells[:, 0] * side + cells[:, 1], xyz[:, 2])
    hit = np.flatnonzero(np.isfinite(lowest))
    if len(hit) < FEWEST_CELLS:
        return None
    z = lowest[hit].astype(np.float64)
    x = (hit // side + 0.5) * CELL - REACH
    y = (hit % side + 0.5) * CELL - REACH
    design = np.stack((x, y, np.ones_like(x)), axis=1)  # (M, 3)
    slope_x, slope_y, height = _robust_fit(design, z)
    normal = np.array([-slope_x, -slope_y, 1.0, -height]) / np.sqrt(slope_x**2 + slope_y**2 + 1)
    return torch.from_numpy(normal.astype(np.float32))


def _robust_fit(design: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Fit z = design @ (slope x, slope y, height): start level at the commonest low height, then reweight."""
    heights = np.sort(z)
    width = max(2, len(heights) // 4)
    spread = heights[width - 1 :] - heights[: len(heights) - width + 1]
    start = int(spread.argmin())  # the densest quarter of the heights
    solution = np.array([0.0, 0.0, np.median(heights[start : start + width])])
    for limit in WIDTHS:
        ratio = (z - design @ solution) / limit
        weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
        # a ridge of a tenth of a cell keeps the slopes from running away where the cells lie in a line
        normal = design.T @ (weight[:, None] * design) + np.diag([1.0, 1.0, 1e-6])
        solution = np.linalg.solve(normal, design.T @ (weight * z) + np.array([0.0, 0.0, 1e-6 * solution[2]]))
    return solution
