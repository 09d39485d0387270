"""A detector and frames small enough that a training step takes milliseconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from beambox.data.kitti import write_kitti_frame
from beambox.data.mixture import MixedSource
from beambox.data.source import FrameList
from beambox.detectors.catalog import build
from beambox.simulate.frames import CAMERA
from beambox.structures import Frame, ImageAttributes, Labels
from beambox.train.config import Recipe, parse_recipe
from beambox.train.dataset import TrainingDataset
from beambox.train.devices import make_fabric
from beambox.train.loop import Run

OPTIONS: dict[str, Any] = {
    "grid": {"minimum": [0.0, -6.4, -3.0], "maximum": [12.8, 6.4, 1.0], "cell": [0.4, 0.4, 4.0]},
    "voxel_channels": 4,
    "depths": [1, 1],
    "strides": [2, 2],
    "widths": [8, 8],
    "up_strides": [1, 2],
    "up_widths": [8, 8],
}
FORKLIFT: dict[str, Any] = {
    "name": "Forklift",
    "size": [3.9, 1.6, 1.5],
    "bottom_z": -1.73,
    "matched_threshold": 0.5,
    "unmatched_threshold": 0.35,
}
"""An anchor of a class of one's own."""


def frames(count: int, seed: int = 0) -> FrameList:
    """Return frames of ground and one car each, made of random points."""
    rng = np.random.default_rng(seed)
    items = []
    for number in range(count):
        center = np.array([rng.uniform(3, 10), rng.uniform(-4, 4), -1.0])
        car = center + rng.uniform(-0.5, 0.5, (60, 3)) * (3.9, 1.6, 1.5)
        ground = np.column_stack((rng.uniform(0, 12, 200), rng.uniform(-6, 6, 200), np.full(200, -1.75)))
        points = np.column_stack((np.concatenate((car, ground)), rng.uniform(0, 1, 260)))
        labels = Labels(torch.tensor([[*center, 3.9, 1.6, 1.5, 0.0]]), ("Car",))
        items.append(Frame(torch.tensor(points, dtype=torch.float32), f"{number:06d}", labels))
    return FrameList(items)


def tiny_kitti(root: Path, count: int = 5, name: str = "Car") -> Path:
    """Write such frames in KITTI's layout, all in `train`, the first two in `val`."""
    names = []
    for frame in frames(count).frames:
        assert frame.labels is not None
        attributes = ImageAttributes(
            torch.zeros(1),
            torch.zeros(1, dtype=torch.int64),
            torch.zeros(1),
            torch.tensor([[500.0, 100.0, 600.0, 200.0]]),
        )
        labels = Labels(frame.labels.boxes, (name,), attributes)
        write_kitti_frame(root, replace(frame, labels=labels, calibration=CAMERA, image_size=(1242, 375)))
        names.append(frame.id)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "train.txt").write_text("\n".join(names))
    (root / "ImageSets" / "val.txt").write_text("\n".join(names[:2]))
    return root


def recipe(**optim: Any) -> Recipe:
    """Return a recipe for the tiny detector."""
    settings = {"lr": 0.003, "iterations": 6, "batch": 2, **optim}
    return parse_recipe(
        {
            "name": "tiny",
            "detector": {"name": "pointpillars", "options": OPTIONS},
            "data": [{"kind": "kitti"}],
            "optim": settings,
            "workers": 0,
            "precision": "float32",
        }
    )


def shuffled(frame: Frame, rng: np.random.Generator, position: int) -> Frame:
    """Augment: the points in another order, mirrored in half of the cases."""
    points = frame.points[rng.permutation(len(frame))]
    assert frame.labels is not None
    if rng.random() < 0.5:
        mirror = torch.tensor([1.0, -1.0, 1.0, 1.0])
        boxes = frame.labels.boxes * torch.tensor([1.0, -1, 1, 1, 1, 1, -1])
        return Frame(points * mirror, frame.id, frame.labels.with_boxes(boxes))
    return frame.with_points(points)


def tiny_run(
    folder: Path, run_recipe: Recipe | None = None, count: int = 5, window: tuple[int, int] | None = (16, 16)
) -> Run:
    """Return a run of the tiny detector that has not begun."""
    run_recipe = run_recipe or recipe()
    torch.manual_seed(run_recipe.seed)
    detector = build(run_recipe.detector.name, run_recipe.detector.options)
    fabric = make_fabric(run_recipe.precision)
    config = detector.config
    dataset = TrainingDataset(
        MixedSource([frames(count)]),
        shuffled,
        config.classes,
        config.grid,
        run_recipe.optim.batch,
        window,
        seed=run_recipe.seed,
        rank=fabric.global_rank,
        world=fabric.world_size,
    )
    return Run(run_recipe, detector, dataset, fabric, folder)
