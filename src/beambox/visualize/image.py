"""Boxes drawn into the camera image, as wire frames whose front is tinted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from beambox.checks import BeamboxError, MissingFileError
from beambox.geometry import Calibration, corners_3d
from beambox.structures import Detections, Labels
from beambox.visualize.canvas import Canvas, Point
from beambox.visualize.colors import BACKGROUND, TRUTH, Color, class_color
from beambox.visualize.label_texts import LabelTexts

__all__ = ["box_edges", "draw_camera", "open_image"]

NEAR = 0.3
"""Metres in front of the camera where edges are cut off; what lies behind would project mirrored."""

# pairs of corners as `corners_3d` orders them: bottom, top, uprights
_EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)])
_FRONT = [0, 3, 7, 4]


def open_image(path: Path) -> Image.Image:
    """Read a picture as RGB.

    Raises:
        BeamboxError: if it is absent or no picture.
    """
    try:
        return Image.open(path).convert("RGB")
    except FileNotFoundError:
        raise MissingFileError(f"{path} is not there") from None
    except (UnidentifiedImageError, OSError) as error:
        raise BeamboxError(f"{path} must be an image, but cannot be read as one ({error})") from None


def box_edges(box: torch.Tensor, calibration: Calibration) -> list[tuple[Point, Point]]:
    """Project the 12 edges of a ``(7,)`` box into the image, each cut where it would pass behind the camera.

    Returns:
        Pairs of pixels (u, v); fewer than 12 where edges lie wholly behind, none where the box does.
    """
    corners = calibration.lidar_to_rect(corners_3d(box[None].cpu().double())[0])  # (8, 3)
    ends = corners.numpy()[_EDGES]  # (12, 2, 3)
    kept = []
    for start, end in ends:
        if start[2] < NEAR and end[2] < NEAR:
            continue
        if min(start[2], end[2]) < NEAR:
            cut = start + (end - start) * (NEAR - start[2]) / (end[2] - start[2])
            start, end = (cut, end) if start[2] < NEAR else (start, cut)  # noqa: PLW2901
        kept.append((start, end))
    if not kept:
        return []
    pixels = calibration.rect_to_image(torch.from_numpy(np.array(kept).reshape(-1, 3)))[0].numpy().reshape(-1, 2, 2)
    return [((float(a[0]), float(a[1])), (float(b[0]), float(b[1]))) for a, b in pixels]


def draw_camera(
    image: Image.Image,
    calibration: Calibration,
    detections: Detections | None = None,
    labels: Labels | None = None,
) -> Image.Image:
    """Draw boxes into a camera image.

    Args:
        image: RGB, of the calibration's camera 2.
        calibration: of the frame.
        detections: in the colour of their class, with their score.
        labels: the truth, in green; below the detections.

    Returns:
        A picture of the image's size.
    """
    canvas = Canvas(image.width, image.height, BACKGROUND)
    canvas.paste(image, (0, 0))
    label_texts = LabelTexts(canvas, image.width, image.height)
    if labels is not None:
        outlines = [_draw_box(canvas, box, calibration, TRUTH) for box in labels.boxes]
        if detections is None:
            _write(label_texts, outlines, [(name, TRUTH) for name in labels.names])
    if detections is not None:
        found = list(zip(detections.boxes, detections.names, detections.scores.tolist()))
        outlines = [_draw_box(canvas, box, calibration, class_color(name)) for box, name, _ in reversed(found)]
        _write(label_texts, outlines[::-1], [(f"{name} {score:.2f}", class_color(name)) for _, name, score in found])
    return canvas.finish()


def _draw_box(canvas: Canvas, box: torch.Tensor, calibration: Calibration, color: Color) -> NDArray[np.floating] | None:
    """Draw one box; return ``(K, 2)`` ends of its edges, or None where nothing of it is in the picture."""
    edges = box_edges(box, calibration)
    reach = 4 * max(canvas.width, canvas.height)  # an edge that leaves the picture far away is not worth its pixels
    edges = [edge for edge in edges if max(map(abs, (*edge[0], *edge[1]))) < reach]
    front = calibration.lidar_to_rect(corners_3d(box[None].cpu().double())[0, _FRONT])  # (4, 3)
    if edges and bool((front[:, 2] > NEAR).all()):
        canvas.polygon([(float(u), float(v)) for u, v in calibration.rect_to_image(front)[0]], color, alpha=56)
    for start, end in edges:
        canvas.line((start, end), BACKGROUND, 3.0, alpha=110)
    for start, end in edges:
        canvas.line((start, end), color, 1.5)
    ends = np.array(edges).reshape(-1, 2)
    inside = (ends >= 0).all(axis=1) & (ends < (canvas.width, canvas.height)).all(axis=1)
    return ends if inside.any() else None


def _write(
    label_texts: LabelTexts, outlines: Sequence[NDArray[np.floating] | None], words: Sequence[tuple[str, Color]]
) -> None:
    shown = [(outline, word) for outline, word in zip(outlines, words) if outline is not None]
    label_texts.above([outline for outline, _ in shown], [word for _, word in shown])
