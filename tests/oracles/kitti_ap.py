"""KITTI's evaluator written a second time, as plain loops over frames, boxes and thresholds; slow on purpose."""

from __future__ import annotations

import math
from dataclasses import dataclass

from shapely.geometry import Polygon

MIN_HEIGHT, MAX_OCCLUSION, MAX_TRUNCATION = (40, 25, 25), (0, 1, 2), (0.15, 0.30, 0.50)
NEIGHBORS = {"Car": "Van", "Pedestrian": "Person_sitting"}


@dataclass
class Row:
    """One line of a label or result file."""

    name: str
    truncated: float
    occluded: float
    alpha: float
    image: tuple[float, float, float, float]
    hwl: tuple[float, float, float]
    location: tuple[float, float, float]
    ry: float
    score: float = 0.0

    @classmethod
    def parse(cls, line: str) -> Row:
        word, *rest = line.split()
        n = [float(value) for value in rest]
        return cls(
            word, n[0], n[1], n[2], tuple(n[3:7]), tuple(n[7:10]), tuple(n[10:13]), n[13], n[14] if n[14:] else 0
        )


def image_iou(a: Row, b: Row, over_first: bool = False) -> float:
    left, top = max(a.image[0], b.image[0]), max(a.image[1], b.image[1])
    right, bottom = min(a.image[2], b.image[2]), min(a.image[3], b.image[3])
    if right <= left or bottom <= top:
        return 0.0
    shared = (right - left) * (bottom - top)
    area_a = (a.image[2] - a.image[0]) * (a.image[3] - a.image[1])
    area_b = (b.image[2] - b.image[0]) * (b.image[3] - b.image[1])
    return shared / (area_a if over_first else area_a + area_b - shared)


def ground_polygon(row: Row) -> Polygon:
    _, w, length = row.hwl
    x, _, z = row.location
    cos, sin = math.cos(row.ry), math.sin(row.ry)
    local = ((length / 2, w / 2), (-length / 2, w / 2), (-length / 2, -w / 2), (length / 2, -w / 2))
    return Polygon([(x + a * cos + b * sin, z - a * sin + b * cos) for a, b in local])


def bev_iou(a: Row, b: Row) -> float:
    p, q = ground_polygon(a), ground_polygon(b)
    shared = p.intersection(q).area
    return shared / (p.area + q.area - shared)


def box_iou(a: Row, b: Row) -> float:
    p, q = ground_polygon(a), ground_polygon(b)
    low = max(a.location[1] - a.hwl[0], b.location[1] - b.hwl[0])
    high = min(a.location[1], b.location[1])
    shared = p.intersection(q).area * max(0.0, high - low)
    return shared / (p.area * a.hwl[0] + q.area * b.hwl[0] - shared)


OVERLAPS = {"2d": image_iou, "bev": bev_iou, "3d": box_iou}


def flags(truth: list[Row], found: list[Row], name: str, level: int) -> tuple[list[int], list[int]]:
    truth_flags, found_flags = [], []
    for row in truth:
        height = row.image[3] - row.image[1]
        hard = (
            height < MIN_HEIGHT[level] or row.occluded > MAX_OCCLUSION[level] or row.truncated > MAX_TRUNCATION[level]
        )
        if row.name == name:
            truth_flags.append(1 if hard else 0)
        else:
            truth_flags.append(1 if row.name == NEIGHBORS.get(name) else -1)
    for row in found:
        if int(abs(row.image[3] - row.image[1])) < MIN_HEIGHT[level]:
            found_flags.append(1)
        else:
            found_flags.append(0 if row.name == name else -1)
    return truth_flags, found_flags


def match(truth, found, truth_flags, found_flags, overlap, minimum, threshold):
    """Return (tp, fp, fn, similarity, scores); threshold None is the first pass."""
    assigned = [False] * len(found)
    tp, fn, similarity, scores = 0, 0, 0.0, []
    for g, truth_flag in zip(truth, truth_flags):
        if truth_flag == -1:
            continue
        best, best_overlap, best_is_ignored = None, 0.0, False
        for j, d in enumerate(found):
            if found_flags[j] == -1 or assigned[j] or (threshold is not None and d.score < threshold):
                continue
            value = overlap(g, d)
            if not value > minimum:
                continue
            if threshold is None:
                if best is None or d.score > found[best].score:
                    best = j
            elif found_flags[j] == 0 and (best is None or best_is_ignored or value > best_overlap):
                best, best_overlap, best_is_ignored = j, value, False
            elif found_flags[j] == 1 and best is None:
                best, best_is_ignored = j, True
        if best is None:
            fn += truth_flag == 0
            continue
        assigned[best] = True
        if truth_flag == 0 and found_flags[best] == 0:
            tp += 1
            scores.append(found[best].score)
            similarity += (1 + math.cos(g.alpha - found[best].alpha)) / 2
    fp = 0
    for j, d in enumerate(found):
        if not assigned[j] and found_flags[j] == 0 and (threshold is None or d.score >= threshold):
            stuff = overlap is image_iou and any(
                image_iou(d, region, over_first=True) > minimum for region in truth if region.name == "DontCare"
            )
            fp += not stuff
    return tp, fp, fn, similarity, scores


def curves(frames: list[tuple[str, str]], name: str, metric: str, level: int, minimum: float):
    """Return the 41-point curves (precision, orientation) and, for all recalls, (recall, precision) pairs."""
    rows = [([Row.parse(x) for x in t.splitlines()], [Row.parse(x) for x in f.splitlines()]) for t, f in frames]
    overlap = OVERLAPS[metric]
    flagged = [(t, f, *flags(t, f, name, level)) for t, f in rows]
    objects = sum(truth_flags.count(0) for _, _, truth_flags, _ in flagged)
    scores = sorted((s for args in flagged for s in match(*args, overlap, minimum, None)[4]), reverse=True)
    thresholds, recall = [], 0.0
    for i, score in enumerate(scores):
        left = (i + 1) / objects
        right = (i + 2) / objects if i < len(scores) - 1 else left
        if right - recall < recall - left and i < len(scores) - 1:
            continue
        thresholds.append(score)
        recall += 1 / 40.0
    precision, orientation = [0.0] * 41, [0.0] * 41
    for k, threshold in enumerate(thresholds):
        results = [match(*args, overlap, minimum, threshold) for args in flagged]
        tp, fp, _, similarity = (sum(r[i] for r in results) for i in range(4))
        precision[k] = tp / (tp + fp) if tp + fp else 0.0
        orientation[k] = similarity / (tp + fp) if tp + fp else 0.0
    for k in range(41):
        precision[k], orientation[k] = max(precision[k:]), max(orientation[k:])
    points = []
    for threshold in sorted({d.score for _, f in rows for d in f}, reverse=True):
        results = [match(*args, overlap, minimum, threshold) for args in flagged]
        tp, fp = sum(r[0] for r in results), sum(r[1] for r in results)
        points.append((tp / objects if objects else 0.0, tp / (tp + fp) if tp + fp else 0.0))
    return precision, orientation, points


def all_point_area(points: list[tuple[float, float]]) -> float:
    """Area under the interpolated curve: each rise of recall at the best precision that follows."""
    area, before = 0.0, 0.0
    for i, (recall, _) in enumerate(points):
        area += (recall - before) * max(p for _, p in points[i:])
        before = recall
    return 100 * area
