"""Density counts, their normalisation, and the branch that condenses them."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beambox.checks import BeamboxError
from beambox.detectors.dennet import CountSet, DensityBranch, Normalization, count_points, normalized, patch_cells
from beambox.geometry.grid import VoxelGrid
from beambox.layers.encoders import VoxelEncoder, mean_voxels
from beambox.ops.voxelize import Voxels, voxelize

CELL = (0.1, 0.1, 0.15)
GRID = VoxelGrid((0.0, -3.2, -3.0), (6.4, 3.2, 3.0), CELL)


def voxels_of(points: torch.Tensor, sample: torch.Tensor | None = None, batch_size: int = 1) -> Voxels:
    sample = torch.zeros(len(points), dtype=torch.int64) if sample is None else sample
    return voxelize(points, sample, batch_size, GRID, max_points=5)


def cloud(seed: int, count: int = 400) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    low, size = torch.tensor([0.5, -2.5, -2.0, 0.0]), torch.tensor([5.0, 5.0, 2.0, 1.0])
    return low + size * torch.rand((count, 4), generator=generator)


def flat_patch(edge: int) -> torch.Tensor:
    """One point in each of ``edge`` x ``edge`` voxels of one height, row by row."""
    steps = (torch.arange(edge) + 20.5) * 0.1
    y, x = torch.meshgrid(steps - 3.2, steps, indexing="ij")
    return torch.stack((x, y, torch.full_like(x, -1.425), torch.zeros_like(x)), dim=-1).reshape(-1, 4)


@pytest.mark.parametrize("count_set", list(CountSet))
def test_a_flat_patch_of_21_by_21_voxels(count_set: CountSet) -> None:
    branch = DensityBranch(count_set=count_set)
    voxels = voxels_of(flat_patch(21))
    sites = mean_voxels(voxels).sites
    middle = int(torch.nonzero((sites.indices[:, 2:] == 30).all(dim=1)))
    assert branch.counts(sites, voxels)[middle].tolist() == [113, 441]
    features = branch.features(sites, voxels)[middle].tolist()
    assert features == pytest.approx([math.log(114) / 4.73705, math.log(442) / 6.92646], abs=1e-5)


def test_normalizations() -> None:
    count = torch.tensor([1, 113, 441])
    assert patch_cells(0.6, CELL) == pytest.approx(113.0973, abs=1e-4)
    assert patch_cells(1.8, CELL) == pytest.approx(1017.876, abs=1e-3)
    assert normalized(count, 0.6, CELL, Normalization.RAW).tolist() == [1, 113, 441]
    assert normalized(count, 0.6, CELL, Normalization.SHARE)[1] == pytest.approx(113 / 113.0973, abs=1e-5)
    assert normalized(count, 0.6, CELL, Normalization.LOG)[2] == pytest.approx(math.log(442), abs=1e-5)
    share = normalized(count, 0.6, CELL, Normalization.LOG_SHARE)
    assert share.tolist() == pytest.approx([math.log(1 + n) / math.log(114.0973) for n in (1, 113, 441)], abs=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 300), st.integers(0, 600), st.sampled_from([0.3, 0.6, 1.8]))
def test_points_are_counted_as_by_looking_at_all_pairs(seed: int, centers: int, points: int, radius: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    # a lattice of tenths, so that many distances are the radius itself
    where = torch.randint(0, 30, (centers + points, 3), generator=generator) / 10
    sample = torch.randint(0, 3, (centers + points,), generator=generator)
    counted = count_points(where[:centers], sample[:centers], where[centers:], sample[centers:], radius)
    away = (where[:centers, None].double() - where[None, centers:].double()).square().sum(dim=2)
    near = (away <= radius**2 + 1e-6) & (sample[:centers, None] == sample[None, centers:])
    assert counted.equal(near.sum(dim=1))


def test_kept_points_are_counted_not_those_dropped() -> None:
    points = torch.cat((flat_patch(1).expand(9, 4), flat_patch(2)[1:]))
    voxels = voxels_of(points)
    sites = mean_voxels(voxels).sites
    assert DensityBranch(count_set=CountSet.POINTS).counts(sites, voxels)[:, 0].tolist() == [8] * 4  # 5 + 3
    assert DensityBranch().counts(sites, voxels)[:, 0].tolist() == [4] * 4
    assert DensityBranch(max_count=3).counts(sites, voxels)[:, 0].tolist() == [3] * 4


def test_features_stand_in_the_order_of_the_encoders_sites() -> None:
    voxels = voxels_of(cloud(1))
    sites = mean_voxels(voxels).sites
    assert not sites.indices.equal(voxels.index), "this cloud must not come in order"
    features = DensityBranch(own_points=5).features(sites, voxels)
    for row in range(0, len(sites), 17):
        index = sites.indices[row]
        own = voxels.count[(voxels.index == index).all(dim=1)]
        assert float(features[row, 2]) == pytest.approx(math.log1p(float(own)) / math.log(6), abs=1e-6)
        near = (sites.indices - index)[:, [3, 2, 1]] * torch.tensor(CELL)
        n = int((near.square().sum(dim=1) <= 0.36 + 1e-6).sum())
        assert float(features[row, 0]) == pytest.approx(math.log1p(n) / math.log1p(patch_cells(0.6, CELL)), abs=1e-6)


def test_samples_do_not_count_each_other() -> None:
    one, two = cloud(1), cloud(2)
    both = voxels_of(torch.cat((one, two)), torch.arange(800) // 400, 2)
    for count_set in CountSet:
        branch = DensityBranch(count_set=count_set)
        joined = branch.features(mean_voxels(both).sites, both)
        alone = [branch.features(mean_voxels(v).sites, v) for v in (voxels_of(one), voxels_of(two))]
        torch.testing.assert_close(joined, torch.cat(alone))


@pytest.mark.parametrize(("levels", "collapse", "channels"), [(40, False, 80), (27, False, 48), (40, True, 32)])
def test_the_maps_channels(levels: int, collapse: bool, channels: int) -> None:
    branch = DensityBranch(collapse=collapse)
    assert branch.bev_channels(levels) == channels
    grid = VoxelGrid((0.0, -3.2, -3.0), (6.4, 3.2, -3.0 + levels * 0.15), CELL)
    points = cloud(1)
    voxels = voxelize(points, torch.zeros(len(points), dtype=torch.int64), 1, grid, 5)
    assert branch(mean_voxels(voxels).sites, voxels).shape == (1, channels, 8, 8)


def test_parameters_of_the_published_branch() -> None:
    assert sum(p.numel() for p in DensityBranch().parameters()) == 14784


def test_the_branch_stands_on_the_encoders_sites() -> None:
    voxels = voxels_of(cloud(1))
    inputs = mean_voxels(voxels)
    stages = VoxelEncoder(4, (4, 4, 4, 4), 8)(inputs)
    known = len(inputs.sites.maps)
    bev = DensityBranch()(inputs.sites, voxels)
    assert bev.shape[2:] == stages.bev.shape[2:]
    assert len(inputs.sites.maps) == known, "no kernel map had to be found anew"


def test_gradients_reach_every_parameter_and_nothing_else() -> None:
    points = cloud(1).requires_grad_()
    branch = DensityBranch()
    voxels = voxels_of(points)
    branch(mean_voxels(voxels).sites, voxels).square().sum().backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in branch.parameters())
    assert points.grad is None


def test_no_points() -> None:
    voxels = voxels_of(torch.zeros(0, 4))
    for count_set in CountSet:
        branch = DensityBranch(count_set=count_set, own_points=5)
        assert not branch(mean_voxels(voxels).sites, voxels).any()


def test_wrong_options_are_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`radii` must name at least one length above 0, got \(0.6, 0\)"):
        DensityBranch((0.6, 0))
    with pytest.raises(BeamboxError, match="`max_count` must be at least 1"):
        DensityBranch(max_count=0)
