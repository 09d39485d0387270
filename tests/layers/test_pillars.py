import pytest
import torch

from beambox.geometry.grid import VoxelGrid
from beambox.layers.pillars import PillarFeatures
from beambox.ops.voxelize import voxelize

GRID = VoxelGrid((0, 0, -3), (4, 4, 1), (1, 1, 4))


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    points = torch.rand(count, 4, generator=torch.Generator().manual_seed(seed))
    return points * torch.tensor([4.0, 4.0, 4.0, 1.0]) - torch.tensor([0.0, 0.0, 3.0, 0.0])


def padded(network: PillarFeatures, voxels, slots: int) -> torch.Tensor:
    """Do what the published code does: fixed slots, zeros where no point is, one maximum over all slots."""
    out = []
    for v in range(len(voxels.index)):
        points = voxels.points[voxels.voxel == v]
        z, y, x = voxels.index[v, 1:].tolist()
        center = torch.tensor([x + 0.5, y + 0.5, z * 4 - 1.0])
        rows = torch.zeros(slots, 10)
        rows[: len(points)] = torch.cat((points, points[:, :3] - points[:, :3].mean(0), points[:, :3] - center), dim=1)
        out.append(torch.relu(network.norm(network.linear(rows))).amax(dim=0))
    return torch.stack(out)


def test_matches_padded_slots_in_evaluation_mode() -> None:
    torch.manual_seed(0)
    network = PillarFeatures(8, empty_slots=6).eval()
    torch.nn.init.normal_(network.norm.bias)
    torch.nn.init.normal_(network.norm.running_mean)
    points = cloud(60)
    voxels = voxelize(points, torch.zeros(60, dtype=torch.int64), 1, GRID, max_points=6)
    torch.testing.assert_close(network(voxels), padded(network, voxels, 6), atol=1e-5, rtol=1e-5)


def test_one_point_and_no_point_train_without_error() -> None:
    network = PillarFeatures(8).train()
    for count in (0, 1):
        voxels = voxelize(cloud(count), torch.zeros(count, dtype=torch.int64), 1, GRID)
        assert network(voxels).shape == (count, 8)


def test_without_absolute_position_a_shift_by_whole_cells_changes_nothing() -> None:
    network = PillarFeatures(8, absolute_xy=False).eval()
    points = cloud(40) * torch.tensor([0.5, 0.5, 1, 1])
    sample = torch.zeros(40, dtype=torch.int64)
    moved = points + torch.tensor([2.0, 1.0, 0.0, 0.0])
    first = network(voxelize(points, sample, 1, GRID))
    second = network(voxelize(moved, sample, 1, GRID))
    torch.testing.assert_close(first, second, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("absolute_xy", [True, False])
def test_far_pillars_look_the_same_in_mixed_precision(absolute_xy: bool) -> None:
    torch.manual_seed(0)
    network = PillarFeatures(16, absolute_xy=absolute_xy).eval()
    grid = VoxelGrid((64, -4, -3), (72, 4, 1), (0.16, 0.16, 4))
    points = cloud(200) * torch.tensor([0.5, 0.5, 0.5, 1]) + torch.tensor([68.0, 2.0, 0.0, 0.0])
    voxels = voxelize(points, torch.zeros(200, dtype=torch.int64), 1, grid)
    seen: list[torch.Tensor] = []
    network.linear.register_forward_hook(lambda _, inputs, out: seen.append(out.detach()))
    network(voxels)
    network.norm.running_mean, network.norm.running_var = seen[0].mean(dim=0), seen[0].var(dim=0)  # as trained here
    exact = network(voxels)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = network(voxels)
    error = (mixed - exact).norm() / exact.norm()
    assert float(error.detach()) < 0.01
