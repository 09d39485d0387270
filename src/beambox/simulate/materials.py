"""Surfaces: how bright they look to a LiDAR, how often they return nothing and how much they let through."""

from __future__ import annotations

import numpy as np

__all__ = ["AIR", "BARK", "DARK", "GLASS", "INSIDE", "LEAVES", "LIGHT", "METAL", "PANE", "RETRO", "RIM", "SKIN", "TIRE",
           "Palette"]  # fmt: skip

# Fixed rows of every palette; the first four are the ground's surfaces in the order of ground.ROAD ... MARKING.
AIR, GLASS, PANE, DARK, TIRE, RIM, RETRO, LIGHT, LEAVES, BARK, METAL, SKIN, INSIDE = range(4, 17)


class Palette:
    """The materials of one scene.

    A row is: intensity at right incidence; exponent of the cosine of incidence; spread of the intensity; power returned
    (how easily it is seen from afar); exponent of the cosine for the power; share of beams let through; intensity
    added where a beam meets the surface at a right angle.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        road = rng.uniform(0.20, 0.38)
        self._rng = rng
        self.rows: list[tuple[float, ...]] = [
            (road, 0.08, 0.05, 1.3, 0.60, 0.0, 0.0),
            (road + rng.uniform(-0.04, 0.10), 0.08, 0.05, 1.4, 0.60, 0.0, 0.0),
            (rng.uniform(0.28, 0.45), 0.03, 0.10, 1.6, 0.45, 0.0, 0.0),
            (rng.uniform(0.45, 0.75), 0.05, 0.10, 3.0, 0.50, 0.0, 0.0),
            (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0),  # AIR
            (0.02, 2.0, 0.03, 0.3, 2.5, rng.uniform(0.90, 0.98), 0.3),  # GLASS of cars: a mirror unless met squarely
            (0.03, 2.0, 0.10, 0.12, 2.0, 0.0, 0.5),  # PANE: a house's or tram's window, mostly lost
            (0.03, 0.5, 0.04, 0.7, 0.5, 0.0, 0.0),  # DARK: seats, underbody
            (0.06, 0.5, 0.05, 0.6, 0.5, 0.0, 0.0),  # TYRE
            (0.30, 1.0, 0.20, 1.5, 0.5, 0.0, 0.3),  # RIM
            (
                3.00,
                0.1,
                0.15,
                8.0,
                0.1,
                0.0,
                0.0,
            ),  # RETRO: plates and signs; beyond what the sensor can tell, also from afar
            (0.80, 0.5, 0.30, 3.0, 0.3, 0.0, 0.0),  # LIGHT: lamps
            (rng.uniform(0.2, 0.4), 0.2, 0.14, 1.6, 0.3, 0.0, 0.0),  # LEAVES
            (rng.uniform(0.15, 0.35), 0.4, 0.10, 1.5, 0.4, 0.0, 0.0),  # BARK
            (rng.uniform(0.15, 0.5), 0.8, 0.12, 1.6, 0.6, 0.0, 0.3),  # METAL: poles, rails
            (0.45, 0.4, 0.08, 1.6, 0.4, 0.0, 0.0),  # SKIN
            (0.03, 0.5, 0.04, 0.06, 0.5, 0.0, 0.0),  # INSIDE of cars: seen through glass twice, so from near alone
        ]

    def add(
        self, intensity: float, exponent: float, spread: float, power: float, power_exponent: float, gloss: float = 0.0
    ) -> int:
        """Add an opaque material and return its index."""
        self.rows.append((intensity, exponent, spread, power, power_exponent, 0.0, gloss))
        return len(self.rows) - 1

    def paint(self) -> int:
        """Add the lacquer of one vehicle: more than half of them look black to a LiDAR unless met at a right angle."""
        rng = self._rng
        gloss = rng.uniform(0.0, 0.45)
        if rng.random() < 0.48:
            return self.add(rng.uniform(0.0, 0.12), rng.uniform(1.0, 3.0), 0.04, rng.uniform(0.12, 0.40), 0.6, gloss)
        return self.add(rng.uniform(0.25, 0.55), rng.uniform(0.4, 1.3), 0.05, rng.uniform(0.3, 1.0), 0.4, gloss)

    def facade(self) -> int:
        """Add the plaster, brick or concrete of one wall."""
        rng = self._rng
        return self.add(
            rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.6), rng.uniform(0.03, 0.1), rng.uniform(1.2, 3.0), 0.3
        )

    def cloth(self) -> int:
        """Add the clothes of one person."""
        rng = self._rng
        return self.add(rng.uniform(0.12, 0.70), 0.3, 0.10, rng.uniform(0.9, 2.2), 0.3)

    def table(self) -> np.ndarray:
        """All rows as a ``(M, 7)`` float64 array."""
        return np.array(self.rows, dtype=np.float64)
