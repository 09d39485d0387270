"""The road as a plane, fitted to the points of a sweep."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = ["fit_ground_plane", "height_and_slope"]

CELL = 2.0
"""Edge of the cells whose lowest points stand for the ground, metres."""
REACH = 40.0
"""Points farther away than this do not vote, metres."""
FEWEST_CELLS = 12
"""Fewer cells than this do not make a plane."""
GUESSES = 40
"""Planes through three cells that are tried first."""
STEEPEST = 0.2
"""Guesses with a steeper slope are left out; the others lose votes in proportion, a quarter at the steepest."""
STEEPNESS_COST = 0.25
WIDTHS = (0.4, 0.3, 0.2, 0.15)
"""Distance at which a cell loses all its say, one entry a round of the fit, metres."""


def fit_ground_plane(points: Tensor) -> Tensor | None:
    """Fit a plane to the ground of a sweep.

    The low point of every 2 m cell within 40 m votes. Of planes through three cells each (always the same choice of
    cells, so that a sweep has one answer) the one near most cells is refined by least squares, reweighted with Tukey's
    biweight of shrinking width: cars, walls and stray returns below the ground lose their say.

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


def height_and_slope(plane: Tensor) -> tuple[float, tuple[float, float]]:
    """Return z of a plane (a, b, c, d) under the origin, and the metres it rises a metre along x and along y."""
    a, b, c, d = plane.tolist()
    return -d / c, (-a / c, -b / c)


def _robust_fit(design: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Fit z = design @ (slope x, slope y, height) to ``(M, 3)`` and ``(M,)``, most of which may be off the plane."""
    solution = _best_guess(design, z)
    for limit in WIDTHS:
        ratio = (z - design @ solution) / limit
        weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
        # a faint pull to the last solution keeps the slopes from running away where the cells lie in a line
        pull = np.diag([1.0, 1.0, 1e-6])
        solution = np.linalg.solve(
            design.T @ (weight[:, None] * design) + pull, design.T @ (weight * z) + pull @ solution
        )
    return solution


def _best_guess(design: np.ndarray, z: np.ndarray) -> np.ndarray:
    triples = np.random.default_rng(0).integers(0, len(z), (GUESSES, 3))
    corners = design[triples]  # (G, 3, 3)
    apart = np.abs(np.linalg.det(corners)) > 10.0  # twice the triangle's area, square metres
    level = np.array([0.0, 0.0, np.median(z)])
    guesses = np.linalg.solve(corners[apart], z[triples[apart], None])[..., 0]  # (G', 3)
    guesses = np.concatenate((level[None], guesses))
    steepness = np.hypot(guesses[:, 0], guesses[:, 1]) / STEEPEST
    votes = (np.abs(z - guesses @ design.T) < WIDTHS[0] / 2).sum(axis=1)  # (G' + 1,)
    return guesses[(votes * (1 - STEEPNESS_COST * steepness) * (steepness < 1)).argmax()]
