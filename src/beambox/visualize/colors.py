"""The colours of pictures: one gradient for points, one colour a class, one for the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["BACKGROUND", "MUTED", "PANEL", "TEXT", "TRUTH", "Color", "class_color", "gradient"]

Color = tuple[int, int, int]

BACKGROUND: Color = (11, 14, 20)
PANEL: Color = (18, 23, 32)
MUTED: Color = (120, 132, 150)
TEXT: Color = (226, 232, 240)
TRUTH: Color = (94, 234, 140)

_CLASSES: dict[str, Color] = {
    "car": (255, 159, 28),
    "vehicle": (255, 159, 28),
    "van": (255, 205, 92),
    "truck": (255, 110, 64),
    "bus": (255, 214, 10),
    "tram": (240, 128, 128),
    "pedestrian": (255, 92, 168),
    "person_sitting": (255, 140, 190),
    "cyclist": (84, 160, 255),
    "motorcycle": (130, 200, 255),
}
_OTHERS: tuple[Color, ...] = ((186, 134, 255), (255, 226, 138), (120, 220, 232), (240, 150, 120), (200, 200, 120))

# Dark to light without red, orange or green, which boxes use: low is deep blue, high is near white.
_STOPS = np.array(
    [(48, 72, 148), (46, 104, 172), (50, 146, 186), (86, 182, 190), (158, 216, 206), (228, 240, 226)], dtype=np.float64
)


def class_color(name: str) -> Color:
    """Return the colour of a class; the same for the same name in every picture."""
    key = name.lower()
    return _CLASSES.get(key) or _OTHERS[sum(key.encode("utf-8", "backslashreplace")) % len(_OTHERS)]


def gradient(share: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Map numbers in [0, 1] (others are clipped, NaN is 0) to ``(..., 3)`` colours, dark to light."""
    place = np.nan_to_num(np.clip(share, 0, 1)) * (len(_STOPS) - 1)
    low = np.minimum(place.astype(np.int64), len(_STOPS) - 2)
    rest = (place - low)[..., None]
    return ((1 - rest) * _STOPS[low] + rest * _STOPS[low + 1]).astype(np.uint8)
