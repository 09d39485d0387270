"""nuScenes' true-positive errors as plain loops over all detections of all frames, written from the paper's text."""

from __future__ import annotations

import math

Box = tuple[float, float, float, float, float, float, float]


def errors(truths: list[list[Box]], founds: list[list[tuple[float, Box]]]) -> tuple[float, float, float]:
    """Return ATE, ASE, AOE of one class.

    Args:
        truths: objects of each frame.
        founds: (score, box) of each frame; all scores differ.
    """
    queue = sorted(((score, frame, box) for frame, found in enumerate(founds) for score, box in found), reverse=True)
    free = [set(range(len(truth))) for truth in truths]
    objects = sum(map(len, truths))
    hits: list[tuple[float, tuple[float, float, float]]] = []  # score, errors
    points: list[tuple[float, float]] = []  # (recall, score) after each detection
    for score, frame, box in queue:
        near = sorted((math.dist(box[:2], truths[frame][i][:2]), i) for i in free[frame])
        if near and near[0][0] < 2:
            truth = truths[frame][near[0][1]]
            free[frame].remove(near[0][1])
            shared = math.prod(min(a, b) for a, b in zip(box[3:6], truth[3:6]))
            scale = 1 - shared / (math.prod(box[3:6]) + math.prod(truth[3:6]) - shared)
            turn = abs(math.atan2(math.sin(box[6] - truth[6]), math.cos(box[6] - truth[6])))
            hits.append((score, (near[0][0], scale, turn)))
        points.append((len(hits) / objects, score))
    averages = []
    for which in range(3):
        means = [sum(e[which] for _, e in hits[: k + 1]) / (k + 1) for k in range(len(hits))]
        values = []
        for percent in range(11, 101):
            confidence = interpolate(percent / 100, points)
            if confidence is None:
                break
            values.append(interpolate(-confidence, [(-score, mean) for (score, _), mean in zip(hits, means)], True))
        averages.append(sum(v for v in values if v is not None) / len(values) if values else 1.0)
    return averages[0], averages[1], averages[2]


def interpolate(x: float, points: list[tuple[float, float]], hold: bool = False) -> float | None:
    """Linear between points of ascending x, the last of equal x at their place; beyond the end None, or held."""
    if x > points[-1][0]:
        return points[-1][1] if hold else None
    if x < points[0][0]:
        return points[0][1]
    at = max(i for i, (where, _) in enumerate(points) if where <= x)
    if points[at][0] == x or at + 1 == len(points):
        return points[at][1]
    (x0, y0), (x1, y1) = points[at], points[at + 1]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
