"""The report's charts, as SVG files that a page holds as pictures: nothing in them can act on the page."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from beambox.metrics.kitti_result import KittiResult
from beambox.report import numbers
from beambox.report.measure import Measured

__all__ = ["calibration_chart", "curves_chart", "error_chart", "group_chart", "score_chart"]

COLORS = ("#2f6fd0", "#e0782f")
"""Of the evaluation, and of the one it is compared with."""
STYLES = ("-", "--", ":")


def _figure(width: float = 4.6, height: float = 3.4) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="tight")
    return figure, figure.add_subplot()


def _svg(figure: Any) -> bytes:
    """Render without dates and random names: the same numbers give the same bytes."""
    import matplotlib

    stream = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "beambox", "font.family": "sans-serif"}):
        figure.savefig(stream, format="svg", metadata={"Date": None}, facecolor="white")
    return stream.getvalue()


def _plain(text: str) -> str:
    """Keep matplotlib from reading a name as a formula."""
    return text.replace("$", r"\$")


def curves_chart(all_of: Sequence[Measured], name: str) -> bytes:
    """Draw the precision-recall curves of a class: the official interpolation at 41 recalls, else at every recall."""
    figure, axes = _figure()
    for one, color in zip(all_of, COLORS):
        if isinstance(one.scored, KittiResult):
            recalls = np.linspace(0, 1, 41)
            for level, average, style in zip(one.scored.levels, one.scored[name].box3d, STYLES):
                if average.curve:
                    label = _plain(f"{one.name}, {level}" if len(all_of) > 1 else level)
                    axes.plot(recalls[1:], average.curve[1:], style, color=color, label=label, linewidth=1.6)
        else:
            recall, precision = numbers.precision_recall(one.matches, name)
            axes.step(recall, precision, where="post", color=color, label=_plain(one.name), linewidth=1.6)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", ylabel="precision, interpolated")
    return _finish(figure, axes)


def score_chart(all_of: Sequence[Measured], name: str) -> bytes:
    """Draw how many detections of a class have which score, the right above the wrong."""
    figure, axes = _figure()
    edges = np.linspace(0, 1, 21)
    for k, (one, color) in enumerate(zip(all_of, COLORS)):
        found = one.matches.found
        mine = (found.name == name) & (found.kind != "ignored")
        right = np.histogram(found.score[mine & (found.kind == "right")], edges)[0]
        wrong = np.histogram(found.score[mine & (found.kind != "right")], edges)[0]
        width = 0.05 / len(all_of)
        at = edges[:-1] + width * (k + 0.5)
        prefix = f"{one.name}, " if len(all_of) > 1 else ""
        axes.bar(at, right, width * 0.9, color=color, label=_plain(f"{prefix}right"))
        axes.bar(at, -wrong, width * 0.9, color=color, alpha=0.4, label=_plain(f"{prefix}wrong"))
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set(xlim=(0, 1), xlabel="score", ylabel="detections: right up, wrong down")
    axes.set_yscale("symlog", linthresh=10)
    return _finish(figure, axes)


def calibration_chart(all_of: Sequence[Measured], name: str) -> bytes:
    """Draw the share of right detections over their score; on the diagonal a score is a probability."""
    figure, axes = _figure()
    axes.plot((0, 1), (0, 1), color="gray", linewidth=0.8, linestyle=":")
    for one, color in zip(all_of, COLORS):
        scores = numbers.calibration(one.matches, name)
        filled = [each for each in scores.bins if each.right + each.wrong]
        share = [each.right / (each.right + each.wrong) for each in filled]
        label = f"{one.name}: error {scores.error:.1f} %" if filled else f"{one.name}: no detections"
        axes.plot([each.mean_score for each in filled], share, "o-", color=color, label=_plain(label), markersize=4)
        for each, height in zip(filled, share):
            axes.annotate(
                str(each.right + each.wrong), (each.mean_score, height), fontsize=6, color=color,
                xytext=(3, -8), textcoords="offset points",
            )  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="mean score", ylabel="share that is right")
    return _finish(figure, axes)


def group_chart(all_of: Sequence[Measured], name: str) -> bytes:
    """Draw AP by distance, occlusion and number of points."""
    figure, axes = _figure(9.4, 3.4)
    labels: list[str] = []
    for one in all_of:
        for group in numbers.groups(one.matches, name):
            label = group.name if group.by != "points" else f"{group.name} pts"
            if label not in labels and group.objects:
                labels.append(label)
    for k, (one, color) in enumerate(zip(all_of, COLORS)):
        values = {
            g.name if g.by != "points" else f"{g.name} pts": g.ap
            for g in numbers.groups(one.matches, name)
            if g.objects
        }
        width = 0.8 / len(all_of)
        at = np.arange(len(labels)) + width * (k - (len(all_of) - 1) / 2)
        heights = [0 if math.isnan(values.get(label, math.nan)) else values[label] for label in labels]
        bars = axes.bar(at, heights, width * 0.92, color=color, label=_plain(one.name))
        axes.bar_label(bars, [f"{value:.0f}" for value in heights], fontsize=7)
    axes.set_xticks(range(len(labels)), labels, rotation=25, ha="right", fontsize=7)
    axes.set(ylim=(0, 108), ylabel="AP over every recall, %")
    return _finish(figure, axes)


def error_chart(all_of: Sequence[Measured], name: str) -> bytes:
    """Draw the signed errors of the matched boxes: mean as a dot, spread as a bar."""
    columns = ("x", "y", "z", "range", "along", "across", "length", "width", "height")
    figure, axes = _figure(9.4, 3.2)
    axes.axhline(0, color="black", linewidth=0.6)
    for k, (one, color) in enumerate(zip(all_of, COLORS)):
        band = one.errors[name]["overall"]
        at = np.arange(len(columns) + 1) + 0.18 * (k - (len(all_of) - 1) / 2)
        mean = [100 * band.mean[c] for c in columns] + [math.degrees(band.mean["heading"])]
        spread = [100 * band.spread[c] for c in columns] + [math.degrees(band.spread["heading"])]
        axes.errorbar(at, mean, spread, fmt="o", color=color, capsize=3, markersize=4, label=_plain(one.name))
    axes.set_xticks(range(len(columns) + 1), [*columns, "heading"])
    axes.set(ylabel="detected - labelled: cm, heading degrees")
    return _finish(figure, axes)


def _finish(figure: Any, axes: Any) -> bytes:
    axes.grid(alpha=0.25)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return _svg(figure)
