"""What a pass of each detector gives a GPU to do, and where the host waits, counted on a CPU (see test_triton.py).

The numbers do not depend on the size of a map or the number of points, so the networks keep their depth and look at a
few square metres. Kernels whose values decide nothing are not run: a launch is counted, and that is all.
"""

import os
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

if os.environ.get("TRITON_INTERPRET") != "1":
    pytest.skip("counts what the interpreter is given", allow_module_level=True)

from torch.utils._python_dispatch import _disable_current_modes
from triton.runtime import interpreter

from beambox.detectors.catalog import CATALOG, build
from beambox.geometry.grid import VoxelGrid
from beambox.infer.predictor import Detector
from beambox.layers.roi import NmsConfig
from beambox.structures import Batch
from beambox.train.config import read_recipe
from oracles.launches import Launches

DECIDE = ("_find_cells", "_spread", "_take_apart", "_stack", "_walk")
MOST = {"network": 400, "decoding": 60}
"""Operations and kernels of a pass of the largest detector, DenNet."""
SPARSE = ("second", "voxel_rcnn", "dennet", "kassd")
"""Detectors with sparse convolutions: after the number of voxels, the sizes of all levels are read together."""


@pytest.fixture
def kernels(monkeypatch):
    """Count launches; run only what decides sizes."""
    counted = Counter()
    run = interpreter.GridExecutor.__call__

    def launch(self, *args, **kwargs):
        counted[self.fn.__name__] += 1
        if self.fn.__name__ in DECIDE:
            with _disable_current_modes():
                run(self, *args, **kwargs)

    monkeypatch.setattr(interpreter.GridExecutor, "__call__", launch)
    return counted


def shrunk(name):
    """The detector of the recipe for KITTI, all its layers, over 32 x 32 cells and with few proposals."""
    recipe = read_recipe(f"{name}-kitti-3class")
    config = build(recipe.detector.name, recipe.detector.options).config
    (x, _, z), cell = config.grid.minimum, config.grid.cell
    grid = VoxelGrid((x, -16 * cell[1], z), (x + 32 * cell[0], 16 * cell[1], config.grid.maximum[2]), cell)
    changed = {"grid": grid, "post": replace(config.post, nms_pre=64, nms_post=20)}
    if hasattr(config, "test_proposals"):
        changed |= {"test_proposals": NmsConfig(64, 6, 0.7), "grid_size": 2}
    if hasattr(config, "kam_options"):
        changed["kam_options"] = replace(config.kam_options, test_boxes=64)
    torch.manual_seed(0)
    return CATALOG[name].build(replace(config, **changed)).eval()


def sweeps(grid, size):
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(grid.minimum), torch.tensor(grid.maximum)
    points = torch.rand((40 * size, 4), generator=generator)
    points[:, :3] = low + points[:, :3] * (high - low)
    return Batch(points, torch.arange(size).repeat_interleave(40), size)


def stages_of(model, total):
    """Note how many launches each part of a network and what lies before it take; returns the notes."""
    notes = [("", 0)]
    for name, part in model.named_children():
        part.register_forward_pre_hook(lambda *_, n=name: notes.append((f"before {n}", total())))
        part.register_forward_hook(lambda *_, n=name: notes.append((n, total())))
    return notes


@pytest.mark.parametrize(("name", "size"), [*((name, 1) for name in CATALOG), ("second", 3), ("hcnet", 3)])
def test_a_pass_is_few_launches_and_hardly_waits(name, size, kernels):
    detector = Detector(shrunk(name), device="cpu", precision="float32")
    batch = sweeps(detector.grid, size)
    with torch.inference_mode():
        detector.model.decode(detector.predict(batch))  # what is made once is made now,
        detector.model.decode(detector.predict(batch))  # or at the second sweep: a CPU passes an empty one then
    kernels.clear()
    network = Launches()
    notes = stages_of(detector.model, lambda: sum(network.operations.values()) + sum(kernels.values()))
    with torch.inference_mode():
        with network:
            predictions = detector.predict(batch)
        before = kernels.copy()
        with Launches() as decoding:
            detector.model.decode(predictions)
    kernels_of_network = sum(before.values())
    launched = (sum(network.operations.values()) + kernels_of_network, sum(decoding.operations.values()))
    decoded = launched[1] + sum(kernels.values()) - kernels_of_network
    stages = [f"{part} {count - before}" for (_, before), (part, count) in pairwise(notes) if count > before]
    stages += [f"after {launched[0] - notes[-1][1]}"]
    print(f"\n| {name} | {launched[0]} | {decoded} | {', '.join(stages)} |")
    assert launched[0] <= MOST["network"], (network.operations, before)
    assert decoded <= MOST["decoding"], (decoding.operations, kernels)
    assert sum(network.reads.values()) == (2 if name in SPARSE else 1), network.reads
    assert decoding.reads == {"cpu": 1}
    assert not network.sent and not decoding.sent, (network.sent, decoding.sent)
