"""Where a beam meets an ellipsoid; compiled with numba."""

from __future__ import annotations

import math

import numba
import numpy as np

__all__ = ["NO_HIT", "hit_ellipsoid"]

NO_HIT = 1e9


@numba.njit(cache=True, nogil=True)
def hit_ellipsoid(
    m: np.ndarray, cx: float, cy: float, cz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Distances at which a beam enters and leaves an ellipsoid, and the cosine of incidence; NO_HIT for a miss."""
    ux, uy, uz = (m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz, m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz,
                  m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz)  # fmt: skip
    vx, vy, vz = (m[0, 0] * cx + m[0, 1] * cy + m[0, 2] * cz, m[1, 0] * cx + m[1, 1] * cy + m[1, 2] * cz,
                  m[2, 0] * cx + m[2, 1] * cy + m[2, 2] * cz)  # fmt: skip
    a, b, c = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz - 1.0
    root = b * b - a * c
    if root <= 0:
        return NO_HIT, NO_HIT, 0.0
    root = math.sqrt(root)
    enter, leave = (b - root) / a, (b + root) / a
    wx, wy, wz = ux * enter - vx, uy * enter - vy, uz * enter - vz
    nx, ny, nz = (m[0, 0] * wx + m[1, 0] * wy + m[2, 0] * wz, m[0, 1] * wx + m[1, 1] * wy + m[2, 1] * wz,
                  m[0, 2] * wx + m[1, 2] * wy + m[2, 2] * wz)  # fmt: skip
    return enter, leave, abs(nx * dx + ny * dy + nz * dz) / math.sqrt(nx * nx + ny * ny + nz * nz)
