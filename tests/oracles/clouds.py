"""Random boxes and points that tests share."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def random_boxes(count: int, generator: torch.Generator, extent: float = 10.0, dtype=torch.float64) -> Tensor:
    """Return (count, 7) boxes of car-like sizes with centres within ``extent`` metres of the origin."""
    boxes = torch.rand(count, 7, generator=generator, dtype=torch.float64)
    boxes[:, :2] = (boxes[:, :2] - 0.5) * 2 * extent
    boxes[:, 2] = (boxes[:, 2] - 0.5) * 4
    boxes[:, 3:6] = 0.3 + boxes[:, 3:6] * 4
    boxes[:, 6] = (boxes[:, 6] - 0.5) * 4 * math.pi
    return boxes.to(dtype)


def fan(count: int, generator: torch.Generator, dtype=torch.float32) -> Tensor:
    """Return (count, 4) points spread as a sweep's camera view: dense near the sensor, 90 degrees wide."""
    r, angle, z, intensity = torch.rand(4, count, generator=generator, dtype=torch.float64)
    r, angle = 2 + 68 * r**2, (angle - 0.5) * math.pi / 2
    return torch.stack((r * angle.cos(), r * angle.sin(), z * 3 - 2.5, intensity), dim=1).to(dtype)
