"""Operations as plain loops over plain numbers: slow, and hard to get wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np


def voxelize(points, sample, minimum, cell, size, max_points=None, max_voxels=None):
    """Return the kept rows of points in order of voxel, and the voxels as {(sample, z, y, x): rows}.

    All arithmetic is float32, the type in which the grid places float32 points.
    """
    f32 = np.float32
    voxels: dict[int, dict[tuple[int, int, int, int], list[int]]] = {}
    for row, point in enumerate(points):
        place = [math.floor((f32(p) - f32(m)) / f32(c)) if math.isfinite(p) else -1
                 for p, m, c in zip(point[:3], minimum, cell)]  # fmt: skip
        if not all(0 <= i < n for i, n in zip(place, size)):
            continue
        b = int(sample[row])
        of_sample = voxels.setdefault(b, {})
        key = (b, place[2], place[1], place[0])
        if key not in of_sample:
            of_sample[key] = []
        of_sample[key].append(row)
    kept = {}
    for b in sorted(voxels):
        for key, rows in list(voxels[b].items())[:max_voxels]:
            kept[key] = rows[:max_points]
    return [row for rows in kept.values() for row in rows], kept


def segment(values, segments, size, reduce: Callable[[Sequence[float]], float]):
    """Reduce each segment and column by a function of a list; 0 where a segment has no row."""
    out = np.zeros((size, values.shape[1]))
    for s in range(size):
        rows = [k for k in range(len(values)) if segments[k] == s]
        for c in range(values.shape[1]):
            if rows:
                out[s, c] = reduce([values[k, c] for k in rows])
    return out


def points_in_boxes(points, boxes):
    """Return the (M, N) mask by turning each point into each box's frame."""
    mask = np.zeros((len(boxes), len(points)), bool)
    for b, (x, y, z, length, width, height, yaw) in enumerate(np.asarray(boxes, np.float64)):
        for i, point in enumerate(np.asarray(points, np.float64)):
            dx, dy, dz = point[0] - x, point[1] - y, point[2] - z
            along = math.cos(yaw) * dx + math.sin(yaw) * dy
            across = -math.sin(yaw) * dx + math.cos(yaw) * dy
            eps = 1e-9
            mask[b, i] = (
                abs(along) <= length / 2 + eps and abs(across) <= width / 2 + eps and abs(dz) <= height / 2 + eps
            )
    return mask


def nms(iou, scores, threshold, pre=4096, post=500):
    """Greedy suppression given the (N, N) IoU of all pairs."""
    order = sorted(range(len(scores)), key=lambda i: (-scores[i], i))[:pre]
    kept: list[int] = []
    for candidate in order:
        if len(kept) < post and all(iou[candidate][k] <= threshold for k in kept):
            kept.append(candidate)
    return kept


def edit_distance(first: Sequence[int], second: Sequence[int]) -> int:
    """Return how many insertions, deletions and replacements turn one sequence into the other (Levenshtein)."""
    row = list(range(len(second) + 1))
    for i, a in enumerate(first, start=1):
        left, row[0] = row[0], i
        for j, b in enumerate(second, start=1):
            left, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, left + (a != b))
    return row[-1]
