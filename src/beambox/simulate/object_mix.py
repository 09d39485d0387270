"""Which objects a street holds, how large they are, and what a data set's labels call them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from beambox.structures.labels import Labels

__all__ = ["KITTI_MIX", "ONCE_MIX", "SIZES", "ObjectMix", "draw_size"]

Size = tuple[float, float, float]

SIZES: dict[str, tuple[Size, Size]] = {
    "Car": ((3.89, 1.62, 1.53), (0.43, 0.10, 0.14)),
    "Van": ((5.08, 1.90, 2.20), (0.70, 0.14, 0.28)),
    "Truck": ((9.50, 2.55, 3.20), (2.20, 0.18, 0.40)),
    "Bus": ((11.11, 2.60, 3.30), (1.00, 0.12, 0.20)),
    "Tram": ((15.5, 2.55, 3.50), (1.50, 0.15, 0.15)),
    "Misc": ((3.20, 1.60, 1.80), (0.90, 0.25, 0.40)),
    "Pedestrian": ((0.84, 0.66, 1.75), (0.20, 0.11, 0.11)),
    "Person_sitting": ((0.80, 0.60, 1.27), (0.12, 0.08, 0.06)),
    "Cyclist": ((1.76, 0.60, 1.73), (0.16, 0.10, 0.09)),
}
"""Length, width, height of KITTI's classes, and of a bus: mean and standard deviation, metres."""


@dataclass(frozen=True)
class ObjectMix:
    """The vehicles and people of a data set; kinds are the keys of :data:`SIZES`."""

    sizes: Mapping[str, tuple[Size, Size]]
    """Mean and standard deviation of each kind's length, width and height, metres."""
    parked: tuple[str, ...]
    """Kinds along the kerb, drawn alike."""
    traffic: Mapping[str, float]
    """Kinds that drive -> their share; shares add up to 1."""
    strays: tuple[str, ...]
    """Kinds in drives and yards, drawn alike."""
    people: tuple[int, int]
    """Fewest groups of people along a lively road, and one more than the most."""
    walking: float
    """Share of the groups that walk."""
    riding: float
    """Share of the groups that walk or ride; the others sit."""
    labels: Mapping[str, str | None]
    """Kind -> what its label says, None for no label."""

    def rename(self, labels: Labels) -> Labels:
        """Give labels the data set's names and leave out what it does not label."""
        labels = labels[torch.tensor([self.labels[name] is not None for name in labels.names], dtype=torch.bool)]
        return replace(labels, names=tuple(str(self.labels[name]) for name in labels.names))


KITTI_MIX = ObjectMix(
    sizes=SIZES,
    parked=("Car",) * 9 + ("Van", "Misc"),
    traffic={"Car": 0.82, "Van": 0.07, "Truck": 0.04, "Cyclist": 0.06, "Tram": 0.01},
    strays=("Car", "Car", "Car", "Van", "Truck", "Misc"),
    people=(1, 8),
    walking=0.68,
    riding=0.95,
    labels={name: name for name in SIZES},
)
"""KITTI's classes: what its cars met in Karlsruhe."""

ONCE_MIX = ObjectMix(
    # means: the anchors of ONCE's public toolbox; spreads are guesses
    sizes=SIZES
    | {
        "Car": ((4.38, 1.87, 1.59), (0.40, 0.09, 0.13)),
        "Van": ((4.95, 1.92, 2.05), (0.45, 0.10, 0.18)),
        "Bus": ((11.11, 2.88, 3.41), (1.20, 0.15, 0.22)),
        "Truck": ((7.52, 2.50, 2.62), (1.80, 0.20, 0.45)),
        "Pedestrian": ((0.75, 0.76, 1.69), (0.12, 0.10, 0.10)),
        "Cyclist": ((2.18, 0.79, 1.43), (0.20, 0.09, 0.12)),
    },
    parked=("Car",) * 16 + ("Van", "Van", "Truck", "Bus"),
    traffic={"Car": 0.64, "Van": 0.06, "Truck": 0.10, "Cyclist": 0.11, "Bus": 0.09},
    strays=("Car", "Car", "Car", "Van", "Truck", "Bus"),
    people=(2, 14),
    walking=0.60,
    riding=1.0,
    # ONCE has no class for vans or trams; trailers stay without a label
    labels={
        "Car": "Car",
        "Van": "Car",
        "Truck": "Truck",
        "Bus": "Bus",
        "Tram": "Bus",
        "Misc": None,
        "Pedestrian": "Pedestrian",
        "Person_sitting": "Pedestrian",
        "Cyclist": "Cyclist",
    },
)
"""ONCE's five classes: more lorries, buses, riders and people."""


def draw_size(kind: str, rng: np.random.Generator, sizes: Mapping[str, tuple[Size, Size]] = SIZES) -> Size:
    """Draw (length, width, height) of a kind; long cars are wide."""
    mean, spread = sizes[kind]
    draw = np.clip(rng.normal(size=3), -2.2, 2.2)
    if kind == "Car":
        draw[1] = 0.5 * draw[0] + 0.85 * draw[1]
    size = [max(m + s * d, 0.55 * m) for m, s, d in zip(mean, spread, draw)]
    return size[0], size[1], size[2]
