"""Learning a sweep by heart: how a test trains on it, and what must be found in it afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from beambox.data.kitti import KittiSource
from beambox.geometry.boxes import wrap_angle
from beambox.geometry.grid import VoxelGrid
from beambox.structures import Batch, Frame
from oracles.paths import data_dir
from oracles.small_detectors import total


def learn_by_heart(model: Any, frame: Frame, steps: int, lr: float, clip: float = float("inf")) -> list[float]:
    """Repeat one sweep with Adam; dropout and random regions stay on. Returns the loss of every step."""
    batch = Batch.of([frame])
    optimizer = torch.optim.Adam(model.train().parameters(), lr=lr)
    losses = []
    for _ in range(steps):
        optimizer.zero_grad()
        loss = total(model.loss(model(batch, labels=batch.labels), batch.labels))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), clip)
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses


def check_found(found: Tensor, labeled: Tensor) -> None:
    """Every labelled box is found within half a metre, and nothing else is."""
    distance = torch.cdist(found[:, :2], labeled[:, :2])
    assert float(distance.amin(dim=0).max()) < 0.5, "every labelled car is found"
    assert float(distance.amin(dim=1).max()) < 0.5, "nothing else is found"


def check_headings(found: Tensor, labeled: Tensor) -> None:
    """Each found box leads where the nearest labelled one does, within half a radian."""
    nearest = torch.cdist(found[:, :2], labeled[:, :2]).argmin(dim=1)
    assert float(wrap_angle(found[:, 6] - labeled[nearest, 6]).abs().max()) < 0.5


def scan_with_cars(grid: VoxelGrid) -> Frame:
    """Return the first real training sweep with at least four cars in a region, labelled with these."""
    for frame in KittiSource(data_dir("kitti"), "train", fov=True):
        if frame.labels is not None:
            cars = frame.labels.of_classes(("Car",))
            cars = cars[grid.contains(cars.boxes)]
            if len(cars) >= 4:
                return replace(frame, labels=cars)
    raise AssertionError("no training sweep with four cars in the region")
