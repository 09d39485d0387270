"""Voxel RoI pooling against loops over grid points and cells; the head."""

from __future__ import annotations

import pytest
import torch

from beambox.geometry.grid import VoxelGrid
from beambox.layers.roi import Rois
from beambox.layers.roi_pool import PoolLevel, RoiHead, VoxelRoiPool
from oracles.sparse_conv import random_sparse
from oracles.voxel_query import query_by_loops

GRID = VoxelGrid((0.0, -3.0, -1.0), (6.0, 3.0, 1.0), (0.25, 0.25, 0.25))
ROIS = Rois(
    torch.tensor(
        [[2.0, 0.5, 0.0, 2.0, 1.0, 0.8, 0.5], [4.0, -1.0, 0.1, 1.0, 1.0, 1.0, -2.0], [90.0, 0, 0, 1, 1, 1, 0]]
    ),
    torch.zeros(3, dtype=torch.int64),
    torch.tensor([0, 1, 1]),
    2,
)


@pytest.fixture
def pool():
    torch.manual_seed(0)
    pool = VoxelRoiPool([5], [PoolLevel(2, (2, 2, 2), 0.9, max_samples=4, channels=6)], grid_size=3).eval()
    for module in pool.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.uniform_(module.running_mean)
            torch.nn.init.uniform_(module.running_var, 0.5, 2)
            torch.nn.init.uniform_(module.weight)
            torch.nn.init.uniform_(module.bias)
    return pool


def level(seed: int, density: float = 0.3):
    return random_sparse(seed, (4, 12, 12), 2, density, 5, torch.float32)


def test_grid_points_fill_the_box_with_z_fastest(pool):
    points = pool.grid_points(torch.tensor([[1.0, 2.0, 3.0, 3.0, 6.0, 9.0, 0.0]]))[0]
    assert points[0].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-5)
    assert points[1].tolist() == pytest.approx([0.0, 0.0, 3.0], abs=1e-5)
    assert points[3].tolist() == pytest.approx([0.0, 2.0, 0.0], abs=1e-5)
    assert points[13].tolist() == pytest.approx([1.0, 2.0, 3.0])


def test_pooling_equals_loops(pool):
    features = level(1)
    gather = pool.levels[0]
    out = pool(ROIS, [features], GRID).reshape(3, 27, 6)
    size = torch.tensor(GRID.cell) * 2
    centers = (features.indices[:, 1:].flip(1) + 0.5) * size + torch.tensor(GRID.minimum)
    points = pool.grid_points(ROIS.boxes)
    for r, p in [(0, 0), (0, 13), (1, 5), (1, 26), (2, 0)]:
        point = points[r, p]
        fine = torch.floor((point - torch.tensor(GRID.minimum)) / torch.tensor(GRID.cell)).long().flip(0)
        cell = torch.cat((ROIS.sample[r, None], torch.div(fine, 2, rounding_mode="floor")))
        rows = query_by_loops(point[None], cell[None], features.sites, centers, (2, 2, 2), 0.9, 4)[0].tolist()
        candidates = []
        for row in rows:
            feature = gather.feature_norm(gather.feature(features.features[[row]])) if row >= 0 else torch.zeros(1, 6)
            away = centers[row] - point if row >= 0 else torch.zeros(3)
            candidates.append(torch.relu(feature + gather.offset_norm(gather.offset(away[None]))))
        pooled = torch.cat(candidates).amax(dim=0, keepdim=True)
        expected = torch.relu(gather.out_norm(gather.out(pooled)))[0]
        torch.testing.assert_close(out[r, p], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("density", [0.0, 0.3])
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_pool_and_head_survive_few_regions_and_no_voxels(pool, density, training, count):
    rois = Rois(ROIS.boxes[:count], ROIS.labels[:count], ROIS.sample[:count], 2)
    pool.train(training)
    head = RoiHead(pool.out_channels, width=8).train(training)
    predictions = head(pool(rois, [level(2, density)], GRID))
    assert predictions.cls.shape == (count,)
    assert predictions.deltas.shape == (count, 7)
    assert predictions.deltas.isfinite().all()
    (predictions.deltas.sum() + predictions.cls.sum()).backward()


def test_gradients_reach_the_voxels(pool):
    features = level(3)
    leaf = features.features.clone().requires_grad_()
    pool.train()(ROIS, [features.with_features(leaf)], GRID).square().sum().backward()
    assert leaf.grad is not None
    assert 0 < int((leaf.grad.abs().sum(dim=1) > 0).sum()) <= len(leaf)
