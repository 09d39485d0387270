"""A detector small enough for tests, with random weights that find something, and a scene for it to look at."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from beambox.detectors.pointpillars import PointPillars, PointPillarsConfig
from beambox.detectors.weights import save_weights
from beambox.geometry import VoxelGrid
from beambox.structures import Batch, Frame

THRESHOLD = 0.1
GRID = VoxelGrid((0.0, -16.0, -3.0), (32.0, 16.0, 1.0), (0.5, 0.5, 4.0))


def tiny_model(seed: int = 0) -> PointPillars:
    """Return a PointPillars of a few thousand values that finds some thirty objects in a street."""
    torch.manual_seed(seed)
    model = PointPillars(
        PointPillarsConfig(
            grid=GRID,
            voxel_channels=8,
            depths=(1, 1),
            strides=(2, 2),
            widths=(8, 16),
            up_strides=(1, 2),
            up_widths=(8, 8),
            absolute_xy=False,
            centered_anchors=True,
        )
    )
    norms = [layer for layer in model.modules() if isinstance(layer, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d)]
    for norm in norms:
        norm.momentum = 1.0  # one pass in training mode makes the statistics those of the street
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        torch.nn.init.normal_(norm.bias, 0, 0.2)
    torch.nn.init.zeros_(model.head.cls.bias)
    torch.nn.init.normal_(model.head.cls.weight, std=0.5)
    batch = Batch.of([Frame(torch.from_numpy(street()))])
    with torch.no_grad():
        model.train()(batch)
        logits = model.eval()(batch).cls.flatten(0, 1)  # (N, classes)
        # one anchor in two hundred is a detection, so equal scores of empty ground stay below
        limit = torch.quantile(logits, 0.995, dim=0) + math.log((1 - THRESHOLD) / THRESHOLD)
        model.head.cls.bias -= limit.repeat(model.head.anchors.per_cell)
    for norm in norms:
        norm.momentum = 0.01
    return model


def tiny_weights(folder: Path, **card: object) -> Path:
    """Write a tiny model's weights and return their path."""
    path = folder / "tiny.safetensors"
    save_weights(path, tiny_model(), {"name": "tiny", **card})
    return path


def street(seed: int = 0, *, height: float = 1.73, ahead_only: bool = False) -> np.ndarray:
    """Return ``(N, 4)`` float32 points of a flat street with walls and three blocks, in BEV its ground."""
    rng = np.random.default_rng(seed)
    ground = np.stack(
        (rng.uniform(-40, 40, 12000), rng.uniform(-15, 15, 12000), rng.normal(-height, 0.02, 12000)), axis=1
    )
    walls = np.stack(
        (
            rng.uniform(-40, 40, 4000),
            rng.choice([-14.0, 14.0], 4000) + rng.normal(0, 0.05, 4000),
            rng.uniform(-height, 4 - height, 4000),
        ),
        axis=1,
    )
    blocks = [
        np.array(center) + rng.uniform(-0.5, 0.5, (300, 3)) * (4.0, 1.7, 1.5)
        for center in ((10, 2, 0.75 - height), (18, -4, 0.75 - height), (-12, 3, 0.75 - height))
    ]
    xyz = np.concatenate((ground, walls, *blocks))
    if ahead_only:
        xyz = xyz[np.abs(np.arctan2(xyz[:, 1], xyz[:, 0])) < np.pi / 4]
    intensity = rng.beta(2, 5, (len(xyz), 1)) * 0.8
    return np.concatenate((xyz, intensity), axis=1).astype(np.float32)


CALIBRATION_TEXT = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P1: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 40 0 700 180 0.2 0 0 1 0.003
P3: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0
"""
LABEL_TEXT = "Car 0.00 0 0.10 500.0 150.0 640.0 260.0 1.50 1.70 4.00 -2.00 1.65 9.73 -1.57\n"


def kitti_folder(root: Path, names: tuple[str, ...] = ("000000", "000001"), *, calib: bool = True) -> Path:
    """Write sweeps in KITTI's layout, with calibration, labels and (for the first) an image; return velodyne/."""
    from PIL import Image

    for kind in ("velodyne", "calib", "label_2", "image_2"):
        (root / "training" / kind).mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        street(seed).tofile(root / "training" / "velodyne" / f"{name}.bin")
        if calib:
            (root / "training" / "calib" / f"{name}.txt").write_text(CALIBRATION_TEXT, encoding="utf-8")
            (root / "training" / "label_2" / f"{name}.txt").write_text(LABEL_TEXT, encoding="utf-8")
    if calib:
        Image.new("RGB", (1200, 360), (90, 110, 130)).save(root / "training" / "image_2" / f"{names[0]}.png")
    return root / "training" / "velodyne"
