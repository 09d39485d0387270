"""A picture drawn at twice its size and shrunk: smooth lines without a display or a plotting library."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from beambox.checks import BeamboxError, printable
from beambox.io import replacing
from beambox.visualize.colors import Color

__all__ = ["SUPER", "Canvas", "save_picture"]

SUPER = 2
"""Pixels drawn for one pixel of the finished picture, along each edge."""

Point = tuple[float, float]


class Canvas:
    """Draws in the pixels of the finished picture; u grows to the right, v downwards."""

    def __init__(self, width: int, height: int, background: Color) -> None:
        self.width, self.height = width, height
        self.image = Image.new("RGB", (width * SUPER, height * SUPER), background)
        self._draw = ImageDraw.Draw(self.image, "RGBA")

    def dots(self, pixels: NDArray[np.floating], colors: NDArray[np.uint8], size: int) -> None:
        """Paint ``(N, 2)`` dots in ``(N, 3)`` colours, later ones over earlier ones; ``size`` in drawn pixels."""
        array = np.array(self.image)
        height, width = array.shape[:2]
        corner = np.floor(pixels * SUPER - (size - 1) / 2).astype(np.int64)
        for du in range(size):
            for dv in range(size):
                u, v = corner[:, 0] + du, corner[:, 1] + dv
                inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
                array[v[inside], u[inside]] = colors[inside]
        self.image = Image.fromarray(array)
        self._draw = ImageDraw.Draw(self.image, "RGBA")

    def line(self, points: Sequence[Point], color: Color, width: float = 1.0, alpha: int = 255) -> None:
        """Draw an open line through points."""
        self._draw.line(_drawn(points), fill=(*color, alpha), width=max(1, round(width * SUPER)), joint="curve")

    def dashes(self, points: Sequence[Point], color: Color, width: float = 1.0, dash: float = 6.0) -> None:
        """Draw a dashed line through points; dashes and gaps are ``dash`` pixels long."""
        for start, end in itertools.pairwise(points):
            span = np.hypot(end[0] - start[0], end[1] - start[1])
            pieces = max(1, round(span / (2 * dash)))
            at = np.linspace(start, end, 2 * pieces + 1)
            for k in range(0, 2 * pieces, 2):
                self.line([tuple(at[k]), tuple(at[k + 1])], color, width)

    def polygon(self, points: Sequence[Point], color: Color, alpha: int = 255) -> None:
        """Fill a polygon."""
        self._draw.polygon(_drawn(points), fill=(*color, alpha))

    def circle(self, center: Point, radius: float, color: Color, width: float = 1.0, alpha: int = 255) -> None:
        """Draw a circle."""
        (u, v), r = center, radius
        around = ((u - r) * SUPER, (v - r) * SUPER, (u + r) * SUPER, (v + r) * SUPER)
        self._draw.ellipse(around, outline=(*color, alpha), width=max(1, round(width * SUPER)))

    def text(
        self, at: Point, words: str, color: Color, size: float = 13, anchor: str = "lm", behind: Color | None = None
    ) -> None:
        """Write one line; ``anchor`` as Pillow names it (lm: left middle), ``behind`` the colour of an outline."""
        place = (at[0] * SUPER, at[1] * SUPER)
        self._draw.text(
            place,
            _shown(words),
            fill=color,
            font=_font(size),
            anchor=anchor,
            stroke_width=0 if behind is None else 2 * SUPER - 1,
            stroke_fill=behind,
        )

    def text_width(self, words: str, size: float = 13) -> float:
        """Return how wide a line of text is, in pixels."""
        return self._draw.textlength(_shown(words), font=_font(size)) / SUPER

    def paste(self, picture: Image.Image, at: tuple[int, int]) -> None:
        """Lay a finished picture onto this one, its upper left corner at ``at``."""
        larger = picture.resize((picture.width * SUPER, picture.height * SUPER), Image.Resampling.NEAREST)
        self.image.paste(larger, (at[0] * SUPER, at[1] * SUPER))

    def finish(self) -> Image.Image:
        """Return the finished picture."""
        return self.image.resize((self.width, self.height), Image.Resampling.BOX)


def save_picture(picture: Image.Image, path: Path) -> None:
    """Write a PNG or JPEG whole or not at all.

    Raises:
        BeamboxError: if the name ends otherwise.
    """
    kinds = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
    kind = kinds.get(path.suffix.lower())
    if kind is None:
        raise BeamboxError(f"a picture is written as .png or .jpg, got the name {path.name}")
    with replacing(path) as stream:
        picture.save(stream, format=kind)


def _drawn(points: Sequence[Point]) -> list[Point]:
    return [(float(u) * SUPER, float(v) * SUPER) for u, v in points]


def _shown(words: str) -> str:
    """One line that fits a legend: names come from files and may hold anything."""
    return printable(" ".join(words.split()) if words.strip() else words, 90)


def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size * SUPER)
