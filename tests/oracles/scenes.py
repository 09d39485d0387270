"""Small labelled frames for tests of data and training."""

from __future__ import annotations

import numpy as np
import torch

from beambox.data.bev_overlap import bev_overlap
from beambox.structures import Frame, Labels


def scene(seed: int, objects: int = 4, name: str = "Car", ground: int = 600, per_object: int = 30) -> Frame:
    """Return a flat road at z = -1.7 with boxes that do not overlap, each with points inside."""
    rng = np.random.default_rng(seed)
    boxes = np.zeros((0, 7))
    while len(boxes) < objects:
        box = np.array([[rng.uniform(5, 45), rng.uniform(-20, 20), -0.95, 4, 1.8, 1.5, rng.uniform(-3.1, 3.1)]])
        if not bev_overlap(box, boxes).any():
            boxes = np.concatenate((boxes, box))
    clouds = []
    for x, y, z, length, width, height, yaw in boxes:
        local = rng.uniform(-0.45, 0.45, (per_object, 3)) * [length, width, height]
        cos, sin = np.cos(yaw), np.sin(yaw)
        clouds.append(
            np.stack(
                (
                    x + cos * local[:, 0] - sin * local[:, 1],
                    y + sin * local[:, 0] + cos * local[:, 1],
                    z + local[:, 2],
                    rng.random(per_object),
                ),
                axis=1,
            )
        )
    road = np.stack(
        (rng.uniform(0, 50, ground), rng.uniform(-25, 25, ground), np.full(ground, -1.7), rng.random(ground)), axis=1
    )
    points = torch.from_numpy(np.concatenate((*clouds, road)).astype(np.float32))
    labels = Labels(torch.from_numpy(boxes.astype(np.float32)), (name,) * objects)
    return Frame(points, f"{seed:06d}", labels)
