"""What a check of a data set found, in words: a table of classes and a list of what looks wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from beambox.data.checking import FLOATING, SOME_FRAMES, TELLING_POINTS, BoxFacts, DataReport
from beambox.data.placements import AS_LABELED, MISTAKES

__all__ = ["class_rows", "format_report", "report_json", "warnings"]

MANY = 0.5
"""Share of a class's boxes from which a fault is taken to be one of the data set, not of single boxes."""
UNEVEN = 0.2
"""The ground may lie this far from where the sensor's height puts it, metres; more costs 3-D overlap."""
STEEP = 0.02
"""A ground that leans by this much in most frames is reported, metres per metre; KITTI's rises by 0.008 ahead."""
FILLED_SHARE = 0.2
"""Fewer boxes than this share with points in them are those of other frames."""
FEW_BOXES = 5
"""Fewer telling boxes than this do not accuse a class."""


def class_rows(report: DataReport) -> list[dict[str, Any]]:
    """Return the statistics of each class, the most frequent first."""
    rows = []
    joined = {name: class_facts.joined() for name, class_facts in report.by_class.items()}
    for name, facts in sorted(joined.items(), key=lambda item: -len(item[1].boxes)):
        boxes, points, gap = facts.boxes, facts.points, facts.gap
        distance = np.hypot(boxes[:, 0], boxes[:, 1])
        rows.append(
            {
                "name": name,
                "boxes": len(boxes),
                "frames": len(report.by_class[name].parts),
                "without_points": int((points == 0).sum()),
                "outside_range": report.by_class[name].outside,
                "median_points": float(np.median(points)),
                "median_size": np.median(boxes[:, 3:6], axis=0).round(2).tolist(),
                "median_z": float(np.median(boxes[:, 2]).round(2)),
                "median_gap": None if np.isnan(gap).all() else float(np.nanmedian(gap).round(2)),
                "farthest": float(distance.max().round(1)),
            }
        )
    return rows


def warnings(report: DataReport, ground: float | None = None) -> list[str]:
    """Say what looks wrong, the gravest first.

    Args:
        report: what was found.
        ground: height of the ground that the description of the data set promises, where it does.
    """
    out = [f"cannot be read: {message}" for message in report.unreadable[:5]]
    if len(report.unreadable) > 5:
        out.append(f"cannot be read: {len(report.unreadable) - 5} more frames")
    out += _frames_that("have no point", report.without_points, report.frames)
    out += _frames_that("have no label file", report.unlabeled, report.frames)
    out += _frames_that("are labelled and have no box", report.without_boxes, report.frames)
    if report.intensity:
        low, high = min(low for low, _ in report.intensity), max(high for _, high in report.intensity)
        if high > 1 or low < 0:
            out.append(f"intensity runs from {low:g} to {high:g}; networks expect 0 to 1: set intensity_scale")
        elif high == 0:
            out.append("intensity is 0 everywhere; train without it, or look whether another column holds it")
    out += [*_scales(report), *_points(report), *_placements(report), *_image_boxes(report)]
    for row in class_rows(report):
        out += _class_warnings(report, row)
    if ground is not None and report.ground:
        wrong = float(np.median(report.ground)) - ground
        if abs(wrong) > UNEVEN:
            side = "above" if wrong > 0 else "below"
            out.append(f"the ground lies {abs(wrong):.2f} m {side} where sensor_height puts it; {_advice(wrong)}")
    return out + _leaning(report)


def _scales(report: DataReport) -> Iterator[str]:
    """Tell of an intensity whose scale was found differently from frame to frame."""
    if len(report.scales) > 1:
        details = ", ".join(f"by {scale} in {count} frames" for scale, count in sorted(report.scales.items()))
        yield f"intensity was divided {details}, by what each frame holds: set intensity_scale so that all are alike"


def _points(report: DataReport) -> Iterator[str]:
    if report.reach and np.median(report.reach) > 1000:
        yield (
            f"95 % of the points of a frame lie within {np.median(report.reach):.4g} of the origin: these are "
            "millimetres or map coordinates, metres around the sensor are expected"
        )
    elif report.reach and np.median(report.reach) < 3:
        yield f"95 % of the points of a frame lie within {np.median(report.reach):.2g} m of the origin; metres expected"
    for up, count in report.up.items():
        if count > MANY * min(len(report.reach), SOME_FRAMES):
            yield f"the ground is a layer across the axis {up[-1]} and {up} is up, but z is expected to be: set axes"


def _placements(report: DataReport) -> Iterator[str]:
    """Name the mistake that would explain boxes without points in them."""
    if report.beyond_a_turn:
        yield (
            f"yaw of {report.beyond_a_turn} boxes is larger than a full turn: is it in degrees? Radians are expected "
            "(a table may call the column yaw_deg)"
        )
    if report.placed < FEW_BOXES or not report.placements:
        return
    here = report.placements[AS_LABELED][0]
    best = max(MISTAKES, key=lambda name: report.placements[name])
    there = report.placements[best][0]
    share = here / report.placed
    if share < MANY and there > max(FEW_BOXES - 1, 1.5 * here):
        yield (
            f"{here} of {report.placed} boxes hold points above the ground as labelled, but {there} {best}: "
            f"{MISTAKES[best][1]}"
        )
    elif share < FILLED_SHARE:
        yield (
            f"only {here} of {report.placed} boxes hold points above the ground: are the labels those of other frames, "
            "or in other axes or units than the points?"
        )


def _image_boxes(report: DataReport) -> Iterator[str]:
    without, total = report.image_boxes
    if any("all image boxes are" in note for note in report.notes):
        yield (
            "all image boxes are 0 (labels made without a camera): KITTI's difficulty levels are unknown, nothing is "
            "filtered by them; score with --no-difficulty"
        )
    elif without > 0.05 * total:
        yield (
            f"{without} of {total} boxes have no box in the image: KITTI's rules neither sample nor score them "
            "(beyond level hard)"
        )


def _leaning(report: DataReport) -> list[str]:
    """Tell of a ground that leans the same way in most frames."""
    if not report.slopes:
        return []
    forward, left = np.median(report.slopes, axis=0)
    if np.hypot(forward, left) < STEEP:
        return []
    ways = [("ahead", "behind", forward), ("to the left", "to the right", left)]
    up, down, most = max(ways, key=lambda way: abs(way[2]))
    return [
        f"the ground rises by {abs(most):.1%} {up if most > 0 else down}, {40 * abs(most):.1f} m at 40 m; "
        f"add {{forward: {forward:.3f}, left: {left:.3f}}} to ground_slope"
    ]


def _advice(wrong: float) -> str:
    return f"{'lower' if wrong > 0 else 'raise'} sensor_height by {abs(wrong):.2f}"


def _frames_that(what: str, names: Sequence[str], frames: int) -> list[str]:
    if not names:
        return []
    some = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    return [f"{len(names)} of {frames} frames {what}: {some}"]


def _class_warnings(report: DataReport, row: dict[str, Any]) -> Iterator[str]:
    name, total = row["name"], row["boxes"]
    facts = report.by_class[name].joined()
    if row["without_points"]:
        yield f"{name}: {row['without_points']} of {total} boxes hold no point; min_points: 1 leaves them out"
    if row["outside_range"]:
        yield f"{name}: {row['outside_range']} of {total} boxes lie outside the range"
    boxes, here, gap = facts.boxes, facts.as_labeled, facts.gap
    length, width = np.median(boxes[:, 3]), np.median(boxes[:, 4])
    if length < 0.8 * width:
        yield f"{name}: length {length:.2f} m is less than width {width:.2f} m; are l and w swapped?"
    if np.median(boxes[:, 5]) > max(2.5, 1.3 * length):
        yield (
            f"{name}: height {np.median(boxes[:, 5]):.2f} m is more than length {length:.2f} m; are the sizes in the "
            "order h, w, l?"
        )
    if length > 100:
        yield f"{name}: length {length:.4g}: metres are expected; are these millimetres or centimetres?"
    long = (np.maximum(boxes[:, 3], boxes[:, 4]) > 1.4 * np.minimum(boxes[:, 3], boxes[:, 4])) & _telling(facts)
    better = facts.across[long] > 1.1 * here[long]
    if long.sum() >= FEW_BOXES and better.mean() > MANY:
        yield (
            f"{name}: {int(better.sum())} of {int(long.sum())} boxes hold more points when turned by 90 degrees; "
            "is yaw 0 along y, or are l and w swapped?"
        )
    else:
        slanted = long & (np.abs(np.sin(2 * boxes[:, 6])) > 0.5)
        better = facts.mirrored[slanted] > 1.1 * here[slanted]
        if slanted.sum() >= FEW_BOXES and better.mean() > MANY:
            yield (
                f"{name}: {int(better.sum())} of {int(slanted.sum())} slanted boxes hold more points with the opposite "
                "heading; does yaw grow clockwise?"
            )
    known = gap[~np.isnan(gap)]
    if len(known) >= FEW_BOXES and abs(np.median(known)) > FLOATING:
        yield _floating(name, float(np.median(known)), float(np.median(boxes[:, 5])))


def _telling(facts: BoxFacts) -> np.ndarray:
    return np.maximum(facts.as_labeled, np.maximum(facts.across, facts.mirrored)) >= TELLING_POINTS


def _floating(name: str, gap: float, height: float) -> str:
    where = f"{abs(gap):.2f} m {'above' if gap > 0 else 'below'} the ground"
    hint = ""
    if abs(abs(gap) - height / 2) < 0.25 * height:
        hint = f"; is z the {'lower' if gap < 0 else 'upper'} face instead of the centre?"
    return f"{name}: boxes stand {where}{hint}"


def format_report(report: DataReport, ground: float | None = None) -> str:
    """Write the report."""
    counts = report.point_counts or [0]
    lines = [f"{report.frames} frames, {int(np.median(counts))} points per frame (from {min(counts)} to {max(counts)})"]
    if report.ground:
        lines.append(f"ground under the origin at z = {np.median(report.ground):.2f} m")
    for note, number in report.notes.items():
        texts = report.note_texts.get(note, {note})
        lines.append(f"{number} frames: {next(iter(texts)) if len(texts) == 1 else note}")
    head = f"{'class':<18}{'boxes':>7}{'frames':>7}{'empty':>7}{'outside':>8}{'points':>8}{'l':>7}{'w':>6}{'h':>6}"
    lines += ["", head + f"{'z':>7}{'gap':>7}{'far':>7}"]
    for row in class_rows(report):
        gap = "-" if row["median_gap"] is None else f"{row['median_gap']:.2f}"
        length, width, height = row["median_size"]
        lines.append(
            f"{row['name']:<18}{row['boxes']:>7}{row['frames']:>7}{row['without_points']:>7}{row['outside_range']:>8}"
            f"{row['median_points']:>8.0f}{length:>7.2f}{width:>6.2f}{height:>6.2f}{row['median_z']:>7.2f}{gap:>7}"
            f"{row['farthest']:>7.1f}"
        )
    lines += [
        "(metres; empty: boxes without a point; points, l, w, h, z, gap: medians; gap: from the ground up to the box)",
        "",
    ]
    found = warnings(report, ground)
    lines += [f"! {line}" for line in found] if found else ["nothing looks wrong"]
    return "\n".join(lines) + "\n"


def report_json(report: DataReport, ground: float | None = None) -> dict[str, Any]:
    """Return the report as plain values."""
    return {
        "frames": report.frames,
        "unreadable": report.unreadable,
        "unlabelled": report.unlabeled,
        "without_points": report.without_points,
        "without_boxes": report.without_boxes,
        "ground": float(np.median(report.ground)) if report.ground else None,
        "classes": class_rows(report),
        "warnings": warnings(report, ground),
    }
