"""ONCE's evaluator written a second time, as plain loops over frames, boxes and thresholds; slow on purpose."""

from __future__ import annotations

import math

from shapely.affinity import rotate, translate
from shapely.geometry import box as rectangle

MERGE = {"Car": "Vehicle", "Bus": "Vehicle", "Truck": "Vehicle"}
MINIMUM = {"Vehicle": 0.7, "Pedestrian": 0.3, "Cyclist": 0.5}


def polygon(b):
    flat = rectangle(-b[3] / 2, -b[4] / 2, b[3] / 2, b[4] / 2)
    return translate(rotate(flat, -b[6], origin=(0, 0), use_radians=True), b[0], b[1])  # clockwise, as the devkit


def iou(a, b):
    turn = abs(a[6] - b[6])
    if turn >= math.pi:
        turn = 2 * math.pi - turn
    if turn > math.pi / 2 or math.hypot(a[0] - b[0], a[1] - b[1]) > 5:
        return 0.0
    tall = max(0.0, min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2))
    shared = polygon(a).intersection(polygon(b)).area * tall
    return shared / (a[3] * a[4] * a[5] + b[3] * b[4] * b[5] - shared)


def in_band(b, band):
    distance = math.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    return (True, distance < 30, 30 <= distance < 50, distance >= 50)[band]


def flag(name, b, wanted, band):
    if not in_band(b, band):
        return 1
    return 0 if MERGE.get(name, name) == wanted else -1


def match(frame, threshold, minimum):
    """Return (tp, fp, scores); threshold None is the first pass."""
    truth_flags, found_flags, scores, overlaps = frame
    assigned = [False] * len(scores)
    kept, tp = [], 0
    for g, truth_flag in enumerate(truth_flags):
        if truth_flag == -1:
            continue
        best, ignored = None, False
        for j, score in enumerate(scores):
            if found_flags[j] == -1 or assigned[j] or not overlaps[g][j] > minimum:
                continue
            if threshold is None:
                if best is None or score > scores[best]:
                    best = j
            elif score >= threshold:
                if found_flags[j] == 0 and (best is None or ignored or overlaps[g][j] > overlaps[g][best]):
                    best, ignored = j, False
                elif found_flags[j] == 1 and best is None:
                    best, ignored = j, True
        if best is not None:
            assigned[best] = True
            if truth_flag == 0 and found_flags[best] == 0:
                tp += 1
                kept.append(scores[best])
    fp = sum(
        not assigned[j] and found_flags[j] == 0 and (threshold is None or scores[j] >= threshold)
        for j in range(len(scores))
    )
    return tp, fp, kept


def thresholds(scores, objects):
    out, q = [], 0.0
    for i, score in enumerate(scores):
        last = i == len(scores) - 1
        left = (i + 1) / objects
        right = left if last else (i + 2) / objects
        if right + left < 2 * q and not last:
            continue
        out.append(score)
        q += 1 / 50
        while right + left + 1e-6 > 2 * q:
            out.append(score)
            q += 1 / 50
    return out


def average_precision(frames, wanted, band):
    """Frames are (truth names, truth boxes, found names, found boxes, scores); percent."""
    flagged = []
    for truth_names, truth, found_names, found, scores in frames:
        overlaps = [[iou(a, b) for b in found] for a in truth]
        truth_flags = [flag(n, b, wanted, band) for n, b in zip(truth_names, truth)]
        found_flags = [flag(n, b, wanted, band) for n, b in zip(found_names, found)]
        flagged.append((truth_flags, found_flags, scores, overlaps))
    objects = sum(f[0].count(0) for f in flagged)
    if not objects:
        return 0.0
    minimum = MINIMUM[wanted]
    kept = sorted((s for f in flagged for s in match(f, None, minimum)[2]), reverse=True)
    precision = [0.0] * 51
    for k, threshold in enumerate(thresholds(kept, objects)):
        results = [match(f, threshold, minimum) for f in flagged]
        tp, fp = sum(r[0] for r in results), sum(r[1] for r in results)
        precision[k] = tp / (tp + fp) if tp + fp else 0.0
    return 100 / 50 * sum(max(precision[k:]) for k in range(1, 51))
