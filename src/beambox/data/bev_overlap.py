"""Which boxes overlap in BEV, in NumPy: augmentation asks it of few boxes, a thousand times per second."""

from __future__ import annotations

import numpy as np

__all__ = ["bev_overlap"]


def bev_overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Tell which boxes overlap in BEV, by the separating axis theorem; boxes that only touch do not.

    Args:
        a: ``(..., 7)`` boxes.
        b: ``(..., 7)`` boxes; leading dimensions broadcast against those of ``a``.

    Returns:
        Broadcast leading shape, bool; of ``(N, 1, 7)`` and ``(M, 7)`` it is ``(N, M)``.
    """
    a, b = a.astype(np.float64, copy=False), b.astype(np.float64, copy=False)
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    cos_a, sin_a, cos_b, sin_b = np.cos(a[..., 6]), np.sin(a[..., 6]), np.cos(b[..., 6]), np.sin(b[..., 6])
    cos = np.abs(cos_a * cos_b + sin_a * sin_b)  # of the angle between the two
    sin = np.abs(sin_a * cos_b - cos_a * sin_b)
    la, wa, lb, wb = a[..., 3] / 2, a[..., 4] / 2, b[..., 3] / 2, b[..., 4] / 2
    return (
        (np.abs(dx * cos_a + dy * sin_a) < la + lb * cos + wb * sin)
        & (np.abs(dy * cos_a - dx * sin_a) < wa + lb * sin + wb * cos)
        & (np.abs(dx * cos_b + dy * sin_b) < lb + la * cos + wa * sin)
        & (np.abs(dy * cos_b - dx * sin_b) < wb + la * sin + wa * cos)
    )
