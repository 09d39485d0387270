"""Voxelization: reference against a plain loop, numba against the reference."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beambox.checks import BeamboxError
from beambox.geometry.grid import VoxelGrid
from beambox.ops.voxelize import Voxels, cpu, reference, voxelize
from oracles import loops
from oracles.clouds import fan
from oracles.paths import data_dir

GRID = VoxelGrid((0.0, -4.0, -1.0), (8.0, 4.0, 1.0), (1.0, 0.5, 2.0))
PILLARS = VoxelGrid((0.0, -39.68, -3.0), (69.12, 39.68, 1.0), (0.16, 0.16, 4.0))
VERSIONS = pytest.mark.parametrize("version", [reference.voxelize, cpu.voxelize], ids=["reference", "numba"])


def cloud(count, generator, batch_size=2, dtype=torch.float32):
    points = torch.rand(count, 5, generator=generator, dtype=dtype) * 10 - 1
    points[:, 1] -= 4
    points[:, 2] = points[:, 2] / 5 - 1
    points[: count // 2] = torch.round(points[: count // 2] * 2) / 2  # on borders, and duplicates
    sample = torch.randint(0, batch_size, (count,), generator=generator).sort().values
    return points, sample


def assert_same(actual: Voxels, want: Voxels):
    assert torch.equal(actual.index, want.index)
    assert torch.equal(actual.count, want.count)
    assert torch.equal(actual.voxel, want.voxel)
    assert torch.equal(actual.points, want.points)
    assert (actual.batch_size, actual.grid) == (want.batch_size, want.grid)


@VERSIONS
@pytest.mark.parametrize("count", [0, 1, 2, 300])
@pytest.mark.parametrize("limits", [(None, None), (1, None), (None, 1), (3, 7)])
def test_voxelize_agrees_with_plain_loop(version, count, limits):
    points, sample = cloud(count, torch.Generator().manual_seed(count))
    actual = version(points, sample, 3, GRID, *limits)
    rows, voxels = loops.voxelize(points.numpy(), sample.numpy(), GRID.minimum, GRID.cell, GRID.size, *limits)
    assert torch.equal(actual.points, points[rows])
    assert actual.index.tolist() == [list(key) for key in voxels]
    assert actual.count.tolist() == [len(v) for v in voxels.values()]
    assert actual.voxel.tolist() == [i for i, v in enumerate(voxels.values()) for _ in v]


@VERSIONS
def test_voxelize_sorts_by_sample_what_comes_mixed(version):
    points = torch.tensor([[0.5, 0, 0], [1.5, 0, 0], [0.5, 0, 0], [2.5, 0, 0]])
    voxels = version(points, torch.tensor([1, 0, 1, 1]), 2, GRID)
    assert voxels.index.tolist() == [[0, 0, 8, 1], [1, 0, 8, 0], [1, 0, 8, 2]]
    assert voxels.voxel.tolist() == [0, 1, 1, 2]


@VERSIONS
def test_voxelize_drops_points_that_are_outside_or_not_finite(version):
    bad = [[-1e-6, 0, 0], [8.0, 0, 0], [1, 4.0, 0], [1, -4.01, 0], [1, 0, 1.0], [1, 0, -1.01]]
    bad += [[np.nan, 0, 0], [1, np.nan, 0], [1, 0, np.nan], [np.inf, 0, 0], [1, -np.inf, 0], [1e30, 0, 0]]
    points = torch.tensor([*bad, [0.0, -4.0, -1.0]])
    voxels = version(points, torch.zeros(len(points), dtype=torch.int64), 1, GRID)
    assert voxels.index.tolist() == [[0, 0, 0, 0]]
    assert torch.equal(voxels.points, points[-1:])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("limits", [(None, None), (5, 700), (1, 10**9)])
@pytest.mark.parametrize("grid", [PILLARS, VoxelGrid((0, -40, -3), (70.4, 40, 1), (0.05, 0.05, 0.1))])
def test_numba_voxelize_equals_reference_on_a_sweep(dtype, limits, grid):
    generator = torch.Generator().manual_seed(7)
    points = torch.cat((fan(6000, generator, dtype), fan(5000, generator, dtype)))
    sample = torch.arange(2).repeat_interleave(torch.tensor([6000, 5000]))
    assert_same(cpu.voxelize(points, sample, 2, grid, *limits), reference.voxelize(points, sample, 2, grid, *limits))


def test_numba_voxelize_equals_reference_on_a_real_scan():
    path = sorted(data_dir("kitti", "training", "velodyne").glob("*.bin"))[0]
    points = torch.from_numpy(np.fromfile(path, np.float32).reshape(-1, 4))
    sample = torch.zeros(len(points), dtype=torch.int64)
    for grid in (PILLARS, VoxelGrid((0, -40, -3), (70.4, 40, 1), (0.05, 0.05, 0.1))):
        assert_same(
            cpu.voxelize(points, sample, 1, grid, 5, 16000), reference.voxelize(points, sample, 1, grid, 5, 16000)
        )


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 60), most=st.integers(1, 4), voxels=st.integers(1, 9))
def test_numba_voxelize_equals_reference_on_any_small_cloud(seed, count, most, voxels):
    points, sample = cloud(count, torch.Generator().manual_seed(seed), batch_size=3)
    sample = sample[torch.randperm(count, generator=torch.Generator().manual_seed(seed))]
    assert_same(
        cpu.voxelize(points, sample, 3, GRID, most, voxels), reference.voxelize(points, sample, 3, GRID, most, voxels)
    )


@VERSIONS
def test_voxelize_hands_the_gradient_to_kept_points(version):
    points, sample = cloud(40, torch.Generator().manual_seed(3), dtype=torch.float64)
    points.requires_grad_()
    out = version(points, sample, 2, GRID, 2, 5).points
    (out * torch.arange(out.numel(), dtype=torch.float64).view_as(out)).sum().backward()
    kept = [loops.voxelize(points.detach().float().numpy(), sample, GRID.minimum, GRID.cell, GRID.size, 2, 5)[0]]
    want = torch.zeros_like(points)
    want[kept[0]] = torch.arange(out.numel(), dtype=torch.float64).view_as(out)
    assert torch.equal(points.grad, want)


def test_voxelize_takes_points_that_are_not_contiguous():
    points, sample = cloud(50, torch.Generator().manual_seed(4))
    wide = torch.cat((points, points), dim=1)[:, :4]
    assert_same(voxelize(wide, sample, 2, GRID), reference.voxelize(wide, sample, 2, GRID))


def test_voxelize_tells_what_is_wrong():
    points, sample = torch.zeros(3, 4), torch.zeros(3, dtype=torch.int64)
    with pytest.raises(BeamboxError, match=r"`points` must have at least 3 columns x, y, z, got 2"):
        voxelize(points[:, :2], sample, 1, GRID)
    with pytest.raises(BeamboxError, match=r"`sample` must lie in 0 .. 0 \(batch_size 1\), got 0 .. 1"):
        voxelize(points, torch.tensor([0, 0, 1]), 1, GRID)
    with pytest.raises(BeamboxError, match=r"`points` has 3, `sample` has 2"):
        voxelize(points, sample[:2], 1, GRID)
    with pytest.raises(BeamboxError, match=r"`max_points` must be at least 1, or None for no limit, got 0"):
        voxelize(points, sample, 1, GRID, max_points=0)
    with pytest.raises(BeamboxError, match=r"`sample` must be int64, got int32"):
        voxelize(points, sample.int(), 1, GRID)
