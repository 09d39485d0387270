"""Anchors and their assignment by plain loops, written from the rules and not from the package's code."""

from __future__ import annotations

import math


def nearest_rectangle(box: list[float]) -> tuple[float, float, float, float]:
    """Return x_min, y_min, x_max, y_max of a box laid along the nearer axis."""
    x, y, _, length, width, _, yaw = box
    folded = yaw - math.floor(yaw / math.pi + 0.5) * math.pi
    if abs(folded) >= math.pi / 4:
        length, width = width, length
    return x - length / 2, y - width / 2, x + length / 2, y + width / 2


def rectangle_iou(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    """Overlap of two axis-aligned rectangles."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    shared = width * height
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def assign_one_class(
    anchors: list[list[float]], boxes: list[list[float]], matched_threshold: float, unmatched_threshold: float
) -> tuple[list[int], list[int]]:
    """Return for each anchor -1, 0 or 1, and the box it answers for."""
    table = [[rectangle_iou(nearest_rectangle(a), nearest_rectangle(b)) for b in boxes] for a in anchors]
    best = [max(row) for row in table]
    choice = [next(b for b, overlap in enumerate(row) if overlap >= max(row) - 1e-6) for row in table]
    label = [1 if m >= matched_threshold else 0 if m < unmatched_threshold else -1 for m in best]
    for b in range(len(boxes)):
        column = [row[b] for row in table]
        if max(column) > 0:
            for a, overlap in enumerate(column):
                if overlap >= max(column) - 1e-6:
                    label[a] = 1
    return label, [c if mark > 0 else 0 for c, mark in zip(choice, label)]
