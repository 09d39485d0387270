"""Voxelization by the GPU's version, on a GPU or through Triton's interpreter (see test_triton.py)."""

import pytest
import torch

from beambox.geometry.grid import VoxelGrid
from beambox.ops.voxelize import gpu, reference

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
GRID = VoxelGrid((0, -8, -3), (16, 8, 1), (0.4, 0.4, 0.5))


def cloud(count, dtype):
    points = torch.rand((count, 5), generator=torch.Generator().manual_seed(count), dtype=dtype)
    points[:, :3] = points[:, :3] * torch.tensor([18, 18, 5]) - torch.tensor([1, 9, 3.5])
    if count > 20:
        points[:12, :3] = (points[:12, :3] / 0.4).round() * 0.4  # on borders, where rounding decides
        points[3, 1], points[4, 0], points[5, 2], points[6, 0] = torch.nan, torch.inf, -torch.inf, 1e30
    return points.to(DEVICE)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 40, 3000])
@pytest.mark.parametrize("limits", [(None, None), (3, 100), (1, 1), (None, 7)])
@pytest.mark.parametrize("samples", ["one", "ascending", "mixed", "gaps"])
def test_voxels_equal_reference(samples, limits, count, dtype):
    points = cloud(count, dtype)
    sample = torch.arange(count, device=DEVICE) * 3 // max(count, 1)
    if samples == "mixed":
        sample = sample[torch.randperm(count, generator=torch.Generator().manual_seed(0)).to(DEVICE)]
    sample = {"one": sample * 0, "gaps": sample * 2 + 1}.get(samples, sample)
    actual, want = (run(points, sample, 7, GRID, *limits) for run in (gpu.voxelize, reference.voxelize))
    for name in ("points", "voxel", "count", "index"):
        assert getattr(actual, name).equal(getattr(want, name)), name


def test_where_all_points_lie_outside_and_columns_are_few():
    points = torch.full((9, 4), 1e3, device=DEVICE)[:, :3]  # rows of another step
    actual = gpu.voxelize(points, torch.zeros(9, dtype=torch.int64, device=DEVICE), 2, GRID, 5, 10)
    assert len(actual) == 0 and actual.points.shape == (0, 3) and actual.index.shape == (0, 4)


def test_gradients_reach_the_kept_points():
    points = cloud(200, torch.float64).nan_to_num(0, 0, 0).requires_grad_()
    sample = torch.zeros(200, dtype=torch.int64, device=DEVICE)
    (gpu.voxelize(points, sample, 1, GRID, 1).points * 2).sum().backward()
    theirs = points.detach().requires_grad_()
    (reference.voxelize(theirs, sample, 1, GRID, 1).points * 2).sum().backward()
    assert points.grad.equal(theirs.grad) and points.grad.any()
