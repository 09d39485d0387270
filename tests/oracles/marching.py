"""Ray casting by walking: steps along a ray and asks each part whether the points lie inside; slow and plain."""

from __future__ import annotations

import math

import numpy as np

from beambox.simulate.raycast import Placed


def to_local(placed: Placed, points: np.ndarray) -> np.ndarray:
    """Undo translation, yaw, pitch and roll of a placed shape, one rotation after the other: (N, 3) -> (N, 3)."""
    x, y, z = (np.asarray(points) - placed.position).reshape(-1, 3).T
    c, s = math.cos(placed.yaw), math.sin(placed.yaw)
    x, y = c * x + s * y, c * y - s * x
    c, s = math.cos(placed.pitch), math.sin(placed.pitch)
    x, z = c * x - s * z, s * x + c * z
    c, s = math.cos(placed.roll), math.sin(placed.roll)
    y, z = c * y + s * z, c * z - s * y
    return np.stack((x, y, z), axis=1)


def depth_inside(placed: Placed, points: np.ndarray, skip: frozenset[int] = frozenset()) -> np.ndarray:
    """How deep points lie in the solid part they are deepest in (negative: outside of all), (N,).

    Depths in half-space sets are metres, in ellipsoids shares of the radius; parts of a material in ``skip`` are not
    solid, nor are leafy ones.
    """
    local = to_local(placed, points)
    deepest = np.full(len(local), -np.inf)
    for kind, first, last, x, y, z, _, density, material in placed.shape.parts:
        if density > 0 or int(material) in skip:
            continue
        if kind:
            matrix = np.array(placed.shape.ellipsoids[int(first)]).reshape(3, 3)
            depth = 1.0 - np.linalg.norm((local - (x, y, z)) @ matrix.T, axis=1)
        else:
            planes = np.array([p[:4] for p in placed.shape.planes[int(first) : int(last)]])
            depth = (planes[:, 3] - local @ planes[:, :3].T).min(axis=1)
        deepest = np.maximum(deepest, depth)
    return deepest


def walk(placed: Placed, direction: np.ndarray, limit: float, step: float = 0.002) -> float:
    """Distance from the origin of the first step that is inside, or infinity."""
    distance = np.arange(0.0, limit, step)
    inside = np.flatnonzero(depth_inside(placed, distance[:, None] * direction) > 0)
    return float(distance[inside[0]]) if len(inside) else math.inf
