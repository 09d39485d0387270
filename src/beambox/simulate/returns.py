"""From what the beams met to what the sensor reports: range noise, drop-outs and intensities."""

from __future__ import annotations

import numpy as np

from beambox.simulate.raycast import Hits
from beambox.simulate.sensors import Sensor

__all__ = ["measure"]

_FULL_POWER = 75.0  # metres; a surface of power 1 at right incidence is lost in 1/e of cases there
_DARK = 0.085  # intensities below this read as zero


def measure(hits: Hits, beams: np.ndarray, directions: np.ndarray, table: np.ndarray, sensor: Sensor,
            rng: np.random.Generator) -> np.ndarray:  # fmt: skip
    """Turn hits into returns.

    Args:
        hits: of ``(R,)`` beams.
        beams: ``(R,)`` z at which each leaves, metres.
        directions: ``(R, 3)`` unit vectors.
        table: ``(M, 7)`` materials, see ``Palette``.
        sensor: its noise, range and sensitivity.
        rng: source of the noise.

    Returns:
        ``(N, 4)`` float32 x, y, z, intensity of the beams that return, in order.
    """
    count = len(hits.distance)
    noise, luck, lit = rng.normal(size=count), rng.random(count), rng.normal(size=count)
    gain, weather = rng.uniform(0.85, 1.15), rng.uniform(0.75, 1.3)
    material = table[hits.material]
    cosine = np.clip(hits.cosine, 0.01, 1.0)
    distance = np.where(np.isfinite(hits.distance), hits.distance, 1.0)
    power = sensor.sensitivity * weather * material[:, 3] * cosine ** material[:, 4]
    seen = luck < 0.985 * (1.0 - np.exp(-power * (_FULL_POWER / np.maximum(distance, 1.0)) ** 2))
    seen &= np.isfinite(hits.distance) & (hits.distance > sensor.min_range) & (hits.distance < sensor.max_range)
    # Very near and far returns read darker, as KITTI's do.
    fade = np.where(
        distance < 16.0, 0.8 + 0.2 * distance / 16.0, 1.0 / (1.0 + (np.maximum(distance - 16.0, 0) / 20.0) ** 2)
    )
    bright = material[:, 0] * cosine ** material[:, 1] + material[:, 6] * cosine**25
    intensity = gain * bright * fade + material[:, 2] * np.sqrt(fade) * lit
    intensity[intensity < _DARK * (1.0 + 0.3 * lit)] = 0.0
    intensity = np.clip(np.round(intensity / sensor.intensity_step) * sensor.intensity_step, 0.0, 0.99)
    reach = distance + sensor.range_noise * noise
    xyz = directions * reach[:, None]
    xyz[:, 2] += beams
    return np.concatenate((xyz, intensity[:, None]), axis=1)[seen].astype(np.float32)
