"""A sweep to turn around in a browser: one HTML file that needs nothing else and can be sent to a colleague."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path

import numpy as np

from beambox.checks import printable
from beambox.structures import Detections, Frame, Labels
from beambox.visualise.colours import TRUTH, Colour, class_colour, gradient

__all__ = ["viewer_html"]

MARK = re.compile(r"\{\{(TITLE|DATA)\}\}")
REACH = 327.0
"""Metres that whole centimetres in 16 bits can hold; points farther away are left out."""


def viewer_html(
    frame: Frame, detections: Detections | None = None, labels: Labels | None = None, *, title: str = ""
) -> str:
    """Return a page that shows points and boxes in three dimensions.

    Points are stored in whole centimetres: about 11 bytes each.

    Args:
        frame: the points.
        detections: in the colour of their class.
        labels: the truth, in green; dashed where detections are shown too.
        title: the frame's name where empty.
    """
    points = frame.points[:, :4].numpy()
    points = points[(np.abs(points[:, :3]) < REACH).all(axis=1)]
    name = title or frame.id or "sweep"
    content = {
        "counts": _counts(len(points), detections, labels),
        "xyz": _packed(np.round(points[:, :3] * 100).astype("<i2")),
        "height": _packed(_shade(points[:, 2])),
        "intensity": _packed(_shade(points[:, 3])),
        "colours": gradient(np.linspace(0, 1, 256)).tolist(),
        "boxes": _boxes(detections, labels),
        "legend": _legend(detections, labels),
    }
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")  # neither a tag nor a comment may begin
    page = Path(__file__).with_name("viewer.html").read_text(encoding="utf-8")
    put_in = {"TITLE": html.escape(printable(name, 500)), "DATA": data}
    return MARK.sub(lambda mark: put_in[mark[1]], page)  # in one pass: what is put in is not looked through again


def _packed(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _shade(values: np.ndarray) -> np.ndarray:
    """Spread values over 256 shades, without the two in a hundred at each end."""
    if not len(values):
        return np.zeros(0, dtype=np.uint8)
    low, high = np.quantile(values, (0.02, 0.98))
    return (255 * np.clip((values - low) / max(high - low, 1e-3), 0, 1)).astype(np.uint8)


def _boxes(detections: Detections | None, labels: Labels | None) -> list[dict[str, object]]:
    out: list[dict[str, object]] = []
    if labels is not None:
        for box, name in zip(labels.boxes.tolist(), labels.names):
            words = name if detections is None else ""
            out.append({"box": _rounded(box), "colour": _css(TRUTH), "label": words, "truth": True})
    if detections is not None:
        for box, name, score in zip(detections.boxes.cpu().tolist(), detections.names, detections.scores.tolist()):
            words, colour = f"{name} {score:.2f}", _css(class_colour(name))
            out.append({"box": _rounded(box), "colour": colour, "label": words, "truth": False})
    return out


def _legend(detections: Detections | None, labels: Labels | None) -> list[dict[str, str]]:
    found = [] if detections is None else sorted(set(detections.names))
    out = [{"words": name, "colour": _css(class_colour(name))} for name in found]
    return out + ([{"words": "ground truth", "colour": _css(TRUTH)}] if labels is not None else [])


def _counts(points: int, detections: Detections | None, labels: Labels | None) -> str:
    words = [f"{points:,} points"]
    words += [] if detections is None else [f"{len(detections)} detections"]
    words += [] if labels is None else [f"{len(labels)} objects"]
    return ", ".join(words)


def _rounded(box: list[float]) -> list[float]:
    return [round(value, 3) for value in box]


def _css(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
