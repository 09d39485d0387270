"""A ball as columns of cells, which is how both fast versions walk through it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from beambox.ops.ball_count.reference import TOLERANCE

__all__ = ["ball_columns", "extent", "map_too_large", "padding"]

LARGEST_MAP = 1 << 28  # words of 64 cells; 2 GiB


def ball_columns(cell: tuple[float, float, float], radius: float) -> np.ndarray:
    """Return the columns of cells that a ball around a cell's centre reaches.

    Args:
        cell: edge lengths x, y, z in metres.
        radius: metres.

    Returns:
        ``(K, 3)`` int64: offset in y, offset in x, and how many cells the ball reaches up and down in that column.
    """
    reach = [math.floor(radius / edge) + 1 for edge in cell]
    x, y = (np.arange(-r, r + 1) for r in reach[:2])
    z = np.arange(reach[2] + 1)
    squared = (  # (Y, X, Z), added in the reference's order
        (x * x * cell[0] ** 2)[None, :, None] + (y * y * cell[1] ** 2)[:, None, None] + (z * z * cell[2] ** 2)
    )
    height = (squared <= radius * radius + TOLERANCE).sum(axis=2) - 1  # (Y, X), -1 where the ball does not reach
    row, column = np.nonzero(height >= 0)
    return np.stack((y[row], x[column], height[row, column]), axis=1)


def extent(index: Tensor) -> tuple[list[int], list[int]]:
    """Return the smallest ``(sample, z, y, x)`` index and the number of cells each axis spans from there."""
    low, high = index.amin(dim=0), index.amax(dim=0)
    return low.tolist(), (high - low + 1).tolist()


def padding(columns: Sequence[np.ndarray]) -> tuple[int, int]:
    """Return how far the columns of some balls reach in y and x."""
    pad_y, pad_x = np.abs(np.concatenate(columns)[:, :2]).max(axis=0)
    return int(pad_y), int(pad_x)


def map_too_large(span: Sequence[int], pad: tuple[int, int]) -> bool:
    """Tell whether the padded map of one sample would not fit into a reasonable memory."""
    return (span[1] // 64 + 1) * (span[2] + 2 * pad[0]) * (span[3] + 2 * pad[1]) > LARGEST_MAP
