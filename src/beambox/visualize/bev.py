"""A sweep in BEV: points, boxes with headings, rings of distance, and a legend that says what is what."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from beambox.geometry import corners_bev
from beambox.structures import Detections, Frame, Labels
from beambox.visualize.canvas import SUPER, Canvas
from beambox.visualize.colors import BACKGROUND, MUTED, PANEL, TEXT, TRUTH, Color, class_color, gradient
from beambox.visualize.label_texts import LabelTexts

__all__ = ["ColorBy", "Region", "draw_bev", "region_of"]

ColorBy = Literal["height", "intensity"]

PANEL_WIDTH = 250
"""Pixels of the legend beside the map."""


@dataclass(frozen=True)
class Region:
    """What a picture shows, in metres of the LiDAR frame (x forward is up, y left is left)."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float


@dataclass(frozen=True)
class _Map:
    """Metres to pixels."""

    region: Region
    scale: float
    """Pixels a metre."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        r = self.region
        return round((r.y_max - r.y_min) * self.scale), round((r.x_max - r.x_min) * self.scale)

    def pixels(self, xy: NDArray[np.floating]) -> NDArray[np.floating]:
        """Carry ``(..., 2)`` x, y in metres to u, v."""
        u = (self.region.y_max - xy[..., 1]) * self.scale
        v = (self.region.x_max - xy[..., 0]) * self.scale
        return np.stack((u, v), axis=-1)

    def sees(self, xy: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which ``(N, 2)`` places lie in the picture."""
        r = self.region
        return (xy[:, 0] >= r.x_min) & (xy[:, 0] <= r.x_max) & (xy[:, 1] >= r.y_min) & (xy[:, 1] <= r.y_max)


def region_of(frame: Frame, boxes: torch.Tensor | None = None, reach: float = 80.0) -> Region:
    """Choose what to show: nearly all points within ``reach`` metres, every box within it, in steps of 5 m."""
    xy = frame.points[:, :2]
    xy = xy[(xy.abs() <= reach).all(dim=1)].double().numpy()
    if len(xy) < 2:
        return Region(-reach / 2, -reach / 2, reach / 2, reach / 2)
    low, high = np.quantile(xy, 0.002, axis=0), np.quantile(xy, 0.998, axis=0)
    low, high = np.minimum(low, 0), np.maximum(high, 0)  # the sensor is always in the picture
    if boxes is not None and len(boxes):
        centers = boxes[:, :2].double().numpy()
        centers = centers[(np.abs(centers) <= reach).all(axis=1)]
        if len(centers):
            low, high = np.minimum(low, centers.min(axis=0) - 3), np.maximum(high, centers.max(axis=0) + 3)
    low, high = np.floor(low / 5 - 0.2) * 5, np.ceil(high / 5) * 5
    narrow = max(0.0, 0.8 * (high[0] - low[0]) - (high[1] - low[1]))  # a street seen ahead would make a ribbon
    low[1], high[1] = low[1] - narrow / 2, high[1] + narrow / 2
    return Region(float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def draw_bev(
    frame: Frame,
    detections: Detections | None = None,
    labels: Labels | None = None,
    *,
    region: Region | None = None,
    detection_range: Region | None = None,
    color_by: ColorBy = "height",
    title: str = "",
    longest: int = 1200,
) -> Image.Image:
    """Draw a sweep in BEV; needs no display.

    Args:
        frame: the points, and a name for the title.
        detections: drawn in the colour of their class, the surer the brighter, with their score.
        labels: the truth, drawn in green; dashed where detections are shown too.
        region: metres to show; chosen from the points where None.
        detection_range: the detector's region, drawn as a thin dashed line.
        color_by: what the points' colours say.
        title: first line of the legend; the frame's name where empty.
        longest: pixels of the map's longer edge.

    Returns:
        An RGB picture: the map, and a legend to its right.
    """
    boxes = [part.boxes.cpu() for part in (detections, labels) if part is not None]
    region = region or region_of(frame, torch.cat(boxes) if boxes else None)
    span = max(region.x_max - region.x_min, region.y_max - region.y_min)
    view = _Map(region, longest / span)
    width, height = view.size
    height = max(height, 420)  # the legend needs this much
    canvas = Canvas(width + PANEL_WIDTH, height, BACKGROUND)
    limits = _draw_points(canvas, view, frame, color_by)
    written = _draw_rings(canvas, view)
    if detection_range is not None:
        _draw_border(canvas, view, detection_range)
    label_texts = LabelTexts(canvas, width, height, [*written, *(_outline(view, torch.cat(boxes)) if boxes else ())])
    if detections is not None:
        _draw_detections(canvas, view, detections)
    if labels is not None:
        _draw_labels(canvas, view, labels, dashed=detections is not None)
    if detections is not None:
        label_texts.beside(
            list(_outline(view, detections.boxes)),
            [(f"{s:.2f}", class_color(n)) for s, n in zip(detections.scores.tolist(), detections.names)],
        )
    elif labels is not None:
        label_texts.beside(list(_outline(view, labels.boxes)), [(name, TRUTH) for name in labels.names])
    _draw_scale(canvas, view)
    _draw_legend(canvas, width, height, frame, detections, labels, color_by, limits, title)
    return canvas.finish()


def _draw_points(canvas: Canvas, view: _Map, frame: Frame, color_by: ColorBy) -> tuple[float, float]:
    points = frame.points.numpy()
    points = points[view.sees(points[:, :2])]
    value = points[:, 2] if color_by == "height" else points[:, 3]
    if len(value):
        low, high = (float(q) for q in np.quantile(value, (0.02, 0.98)))
    else:
        low, high = 0.0, 1.0
    high = max(high, low + 1e-3)
    order = np.argsort(value, kind="stable")  # the high stand over the low
    colors = gradient((value[order] - low) / (high - low))
    canvas.dots(view.pixels(points[order, :2]), colors, size=3 if len(points) < 60_000 else 2)
    return low, high


def _draw_rings(canvas: Canvas, view: _Map) -> list[NDArray[np.floating]]:
    """Draw circles of distance; return the corners of their labels."""
    r = view.region
    far = math.hypot(max(abs(r.x_min), abs(r.x_max)), max(abs(r.y_min), abs(r.y_max)))
    step = 10 if far <= 110 else 20
    written: list[NDArray[np.floating]] = []
    center = view.pixels(np.array([0.0, 0.0]))
    u, v = float(center[0]), float(center[1])
    for distance in range(step, int(far) + 1, step):
        canvas.circle((u, v), distance * view.scale, MUTED, width=0.5, alpha=90)
        at = v - distance * view.scale  # the label stands on the ring, straight ahead; else straight behind
        at = at if at > 8 else v + distance * view.scale
        if 8 < at < view.size[1] - 8:
            canvas.text((u + 4, at), f"{distance} m", MUTED, size=11, behind=BACKGROUND)
            written.append(np.array([(u + 4, at - 6), (u + 34, at + 6)]))
    nose, left, right = (u, v - 9), (u - 6, v + 6), (u + 6, v + 6)
    canvas.polygon((nose, left, (u, v + 3), right), TEXT)
    return written


def _draw_border(canvas: Canvas, view: _Map, detection_range: Region) -> None:
    x0, y0, x1, y1 = detection_range.x_min, detection_range.y_min, detection_range.x_max, detection_range.y_max
    corners = view.pixels(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]))
    canvas.dashes([(float(u), float(v)) for u, v in corners], MUTED, width=0.75, dash=5)


def _outline(view: _Map, boxes: torch.Tensor) -> NDArray[np.floating]:
    return view.pixels(corners_bev(boxes.cpu().double()).numpy())  # (N, 4, 2)


def _draw_heading(canvas: Canvas, corners: NDArray[np.floating], color: Color, width: float, alpha: int) -> None:
    front = (corners[0] + corners[3]) / 2
    center = corners.mean(axis=0)
    canvas.line((tuple(center), tuple(front)), color, width, alpha)


def _draw_labels(canvas: Canvas, view: _Map, labels: Labels, dashed: bool) -> None:
    for corners in _outline(view, labels.boxes):
        ring = [tuple(c) for c in (*corners, corners[0])]
        if dashed:
            canvas.dashes(ring, TRUTH, width=1.5, dash=4)
        else:
            canvas.polygon(ring, TRUTH, alpha=36)
            canvas.line(ring, TRUTH, width=1.5)
        _draw_heading(canvas, corners, TRUTH, 1.5, 255)


def _draw_detections(canvas: Canvas, view: _Map, detections: Detections) -> None:
    scores = detections.scores.cpu().tolist()
    outlines = list(zip(_outline(view, detections.boxes), detections.names, scores))
    for corners, name, score in reversed(outlines):  # the surest on top
        color, alpha = class_color(name), score_alpha(score)
        ring = [tuple(c) for c in (*corners, corners[0])]
        canvas.polygon(ring, color, alpha=alpha // 5)
        canvas.line(ring, color, width=2, alpha=alpha)
        _draw_heading(canvas, corners, color, 2, alpha)


def score_alpha(score: float) -> int:
    """Return how opaque a detection is drawn: a third at score 0, wholly from 0.7 on."""
    return round(255 * min(1.0, 0.3 + max(score, 0.0)))


def _draw_scale(canvas: Canvas, view: _Map) -> None:
    length = 10 * view.scale
    u, v = 16.0, view.size[1] - 18.0
    canvas.line(((u, v - 4), (u, v), (u + length, v), (u + length, v - 4)), TEXT, width=1.5)
    canvas.text((u + length / 2, v - 9), "10 m", TEXT, size=11, anchor="mm", behind=BACKGROUND)


def _draw_legend(
    canvas: Canvas,
    left: int,
    height: int,
    frame: Frame,
    detections: Detections | None,
    labels: Labels | None,
    color_by: ColorBy,
    limits: tuple[float, float],
    title: str,
) -> None:
    canvas.polygon(((left, 0), (left + PANEL_WIDTH, 0), (left + PANEL_WIDTH, height), (left, height)), PANEL)
    u, v = left + 18, 30
    canvas.text((u, v), title or frame.id or "sweep", TEXT, size=17)
    v += 24
    canvas.text((u, v), f"{len(frame):,} points", MUTED, size=12)
    v += 34
    if detections is not None:
        v = _legend_detections(canvas, u, v, detections)
    if labels is not None:
        v = _legend_labels(canvas, u, v, labels, dashed=detections is not None)
    _legend_gradient(canvas, u, v, color_by, limits)


def _legend_detections(canvas: Canvas, u: float, v: float, detections: Detections) -> float:
    canvas.text((u, v), f"Detections: {len(detections)}", TEXT, size=13)
    v += 24
    names = detections.names
    for name in detections.classes:
        scores = [s for s, n in zip(detections.scores.tolist(), names) if n == name]
        best = f"{len(scores)}, best {max(scores):.2f}" if scores else "0"
        _swatch(canvas, u, v, class_color(name), 255)
        canvas.text((u + 38, v), f"{name}: {best}", TEXT if scores else MUTED, size=12)
        v += 22
    for k, score in enumerate((0.1, 0.4, 0.7)):
        _swatch(canvas, u + 66 * k, v, TEXT, score_alpha(score))
        canvas.text((u + 66 * k + 34, v), f"{score}{'+' if score == 0.7 else ''}", MUTED, size=11)
    return v + 36


def _legend_labels(canvas: Canvas, u: float, v: float, labels: Labels, dashed: bool) -> float:
    canvas.text((u, v), f"Ground truth: {len(labels)}", TEXT, size=13)
    v += 24
    for name in sorted(set(labels.names)):
        if dashed:
            canvas.dashes(((u, v), (u + 26, v)), TRUTH, width=1.5, dash=4)
        else:
            _swatch(canvas, u, v, TRUTH, 255)
        canvas.text((u + 38, v), f"{name}: {labels.names.count(name)}", TEXT, size=12)
        v += 22
    return v + 14


def _swatch(canvas: Canvas, u: float, v: float, color: Color, alpha: int) -> None:
    ring = ((u, v - 6), (u + 26, v - 6), (u + 26, v + 6), (u, v + 6), (u, v - 6))
    canvas.polygon(ring, color, alpha // 5)
    canvas.line(ring, color, width=2, alpha=alpha)
    canvas.line(((u + 13, v), (u + 26, v)), color, width=2, alpha=alpha)


def _legend_gradient(canvas: Canvas, u: float, v: float, color_by: ColorBy, limits: tuple[float, float]) -> None:
    words, unit = ("Height z", " m") if color_by == "height" else ("Intensity", "")
    canvas.text((u, v), words, TEXT, size=13)
    v += 18
    width = PANEL_WIDTH - 36
    colors = gradient(np.linspace(0, 1, width * SUPER))
    bar = np.broadcast_to(colors, (10 * SUPER, *colors.shape))
    canvas.image.paste(Image.fromarray(np.ascontiguousarray(bar)), (round(u * SUPER), round((v - 4) * SUPER)))
    digits = 1 if color_by == "height" else 2
    canvas.text((u, v + 18), f"{limits[0]:.{digits}f}{unit}", MUTED, size=11)
    canvas.text((u + width, v + 18), f"{limits[1]:.{digits}f}{unit}", MUTED, size=11, anchor="rm")
