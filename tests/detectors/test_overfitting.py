"""Gradients that work: a network learns one real labelled sweep by heart, on a CPU, in minutes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from beambox.data.kitti import KittiSource
from beambox.detectors.second import KITTI_CAR, second
from beambox.detectors.voxel_rcnn import VoxelRCNNConfig, voxel_rcnn
from beambox.geometry.grid import VoxelGrid
from beambox.ops.points_in_boxes import points_in_boxes_mask
from beambox.ops.rotated_iou import iou_3d
from beambox.structures import Batch, Frame
from oracles.paths import data_dir

pytestmark = pytest.mark.slow

REGION = VoxelGrid((0.0, -20.0, -3.0), (40.0, 20.0, 1.0), (0.1, 0.1, 0.1))
STEPS = 120


def sweep_with_cars() -> Frame:
    """Return the first training sweep with at least two cars, all of them inside the region and well seen."""
    source = KittiSource(data_dir("kitti"), "train", fov=True)
    for index in range(len(source)):
        labels = source.labels(index)
        if labels is None or not 2 <= len(labels.of_classes(("Car",))) <= 5:
            continue
        cars = labels.of_classes(("Car",))
        frame = source[index]
        seen = points_in_boxes_mask(frame.points, cars.boxes).sum(dim=1)
        if bool(REGION.contains(cars.boxes).all()) and bool((seen >= 50).all()):
            return Frame(frame.points, frame.id, labels=cars)
    raise AssertionError("no training sweep with two cars near the sensor")


def learn_by_heart(model: nn.Module) -> None:
    """Train on one sweep; the loss must fall to a tenth and every car be found at an IoU of 0.7."""
    for module in model.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.momentum = 0.1  # the statistics must settle within these few steps
    frame = sweep_with_cars()
    batch = Batch.of([frame])
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.003, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 0.003, total_steps=STEPS, pct_start=0.3)
    totals = []
    for step in range(STEPS):
        torch.manual_seed(step)
        loss = sum(model.loss(model(batch, labels=batch.labels), batch.labels).values())
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 10)
        optimizer.step()
        schedule.step()
        totals.append(float(loss.detach()))
    model.eval()
    with torch.inference_mode():
        found = model.decode(model(batch))[0]
    first, last = totals[0], sum(totals[-5:]) / 5
    overlap = iou_3d(frame.labels.boxes, found.boxes) if len(found) else torch.zeros(len(frame.labels), 1)
    best = overlap.amax(dim=1)
    print(f"\nsweep {frame.id}: loss {first:.3f} -> {last:.3f}; best overlaps {[round(v, 2) for v in best.tolist()]}")
    assert last < first / 10
    assert bool((best >= 0.7).all())


def test_second_learns_one_sweep_by_heart():
    torch.manual_seed(0)
    learn_by_heart(second(replace(KITTI_CAR, grid=REGION, widths=(64, 128), up_widths=(128, 128), depths=(2, 2))))


def test_voxel_rcnn_learns_one_sweep_by_heart():
    torch.manual_seed(0)
    config = replace(VoxelRCNNConfig(), grid=REGION, depths=(2, 2))
    learn_by_heart(voxel_rcnn(config))
