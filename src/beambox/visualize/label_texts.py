"""Words beside boxes, each where it covers nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from beambox.visualize.canvas import Canvas
from beambox.visualize.colors import BACKGROUND, Color

__all__ = ["LabelTexts"]

Space = tuple[float, float, float, float]


class LabelTexts:
    """Places words on a canvas; a tag without room is left out, so the most important come first."""

    def __init__(self, canvas: Canvas, width: int, height: int, boxes: Iterable[NDArray[np.floating]] = ()) -> None:
        """Start with nothing written.

        Args:
            canvas: to write on.
            width: pixels that words must stay within.
            height: likewise.
            boxes: ``(K, 2)`` corners in pixels of what words must not cover either.
        """
        self.canvas, self.width, self.height = canvas, width, height
        self._taken: list[Space] = []
        for corners in boxes:
            (u0, v0), (u1, v1) = corners.min(axis=0), corners.max(axis=0)
            self._taken.append((u0, v0, u1, v1))

    def beside(self, outlines: Iterable[NDArray[np.floating]], words: Sequence[tuple[str, Color]]) -> None:
        """Write right, left, above or below boxes of ``(K, 2)`` corners, in pixels."""
        for corners, (text, color) in zip(outlines, words):
            half, tall = self._half_size(text, 11)
            (u0, v0), (u1, v1) = corners.min(axis=0), corners.max(axis=0)
            u, v = (u0 + u1) / 2, (v0 + v1) / 2
            places = ((u1 + half + 4, v), (u0 - half - 4, v), (u, v0 - tall - 2), (u, v1 + tall + 2))
            self._write(places, text, color, 11)

    def above(self, outlines: Iterable[NDArray[np.floating]], words: Sequence[tuple[str, Color]]) -> None:
        """Write above boxes of ``(K, 2)`` corners, or below them, in pixels."""
        for corners, (text, color) in zip(outlines, words):
            _, tall = self._half_size(text, 13)
            (u0, v0), (u1, v1) = corners.min(axis=0), corners.max(axis=0)
            u = (max(0.0, u0) + min(float(self.width), u1)) / 2
            self._write(((u, v0 - tall - 2), (u, v1 + tall + 2)), text, color, 13)

    def _half_size(self, words: str, size: float) -> tuple[float, float]:
        return self.canvas.text_width(words, size) / 2, size * 0.6

    def _write(self, places: Iterable[tuple[float, float]], words: str, color: Color, size: float) -> None:
        half, tall = self._half_size(words, size)
        for u, v in places:
            space = (u - half, v - tall, u + half, v + tall)
            inside = space[0] > 0 and space[1] > 0 and space[2] < self.width and space[3] < self.height
            if inside and not any(_overlap(space, other) for other in self._taken):
                self._taken.append(space)
                self.canvas.text((u, v), words, color, size=size, anchor="mm", behind=BACKGROUND)
                return


def _overlap(a: Space, b: Space) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
