"""Ball counts: the reference against a KD-tree, numba against the reference, patches counted by hand."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from beambox.checks import BeamboxError
from beambox.geometry.grid import VoxelGrid
from beambox.ops.ball_count import ball_count, ball_counts, cpu, reference
from beambox.ops.voxelize import voxelize
from oracles.clouds import fan
from oracles.paths import data_dir


def by_bits(index, cell, radius):
    """The numba version for one radius, in the company of others, which share its map."""
    return cpu.ball_counts(index, cell, (0.37, radius, 2 * radius))[:, 1]


VERSIONS = pytest.mark.parametrize("version", [reference.ball_count, by_bits], ids=["reference", "numba"])
CELL = (0.1, 0.1, 0.15)
GRID = VoxelGrid((0, -40, -3), (70.4, 40, 3), CELL)


def by_tree(index, cell, radius):
    """Count with scipy's KD-tree; the radius is widened as the tolerance on squares demands."""
    index = index.numpy()
    out = np.zeros(len(index), np.int64)
    for sample in np.unique(index[:, 0]):
        rows = np.flatnonzero(index[:, 0] == sample)
        centers = (index[rows][:, [3, 2, 1]] + 0.5) * np.array(cell)
        tree = cKDTree(np.unique(centers, axis=0))
        out[rows] = tree.query_ball_point(centers, np.sqrt(radius**2 + 1e-6), return_length=True)
    return out


def random_index(count, generator, sizes=(2, 9, 30, 30)):
    return torch.stack([torch.randint(0, size, (count,), generator=generator) for size in sizes], dim=1)


@VERSIONS
@pytest.mark.parametrize("count", [1, 2, 400])
@pytest.mark.parametrize("radius", [0.01, 0.15, 0.6, 1.8, 5.0])
def test_ball_count_equals_kd_tree(version, count, radius):
    index = random_index(count, torch.Generator().manual_seed(count))  # with duplicates at 400
    assert version(index, CELL, radius).tolist() == by_tree(index, CELL, radius).tolist()


@VERSIONS
def test_ball_count_of_tall_grids_and_negative_or_distant_indices(version):
    index = random_index(300, torch.Generator().manual_seed(5), (2, 200, 4, 4))
    index += torch.tensor([3, -70, 100_000, -5])
    for radius in (0.6, 1.8, 20.0):
        assert version(index, CELL, radius).tolist() == by_tree(index, CELL, radius).tolist()


@VERSIONS
def test_ball_count_of_flat_patch(version):
    y, x = torch.meshgrid(torch.arange(21), torch.arange(21), indexing="ij")
    zero = torch.zeros(441, dtype=torch.int64)
    index = torch.stack((zero, zero, y.flatten(), x.flatten()), dim=1)
    assert version(index, CELL, 0.6)[220] == 113  # dx^2 + dy^2 <= 36, the border included
    assert version(index, CELL, 1.8)[220] == 441


def test_numba_falls_back_where_the_map_would_be_huge():
    index = torch.tensor([[0, 0, 0, 0], [0, 0, 10**6, 10**6], [0, 0, 10**6, 10**6 + 1]])
    assert by_bits(index, CELL, 0.6).tolist() == [1, 2, 2]


@pytest.mark.parametrize("radius", [0.6, 1.8])
def test_numba_ball_count_equals_kd_tree_on_scans(radius):
    path = sorted(data_dir("kitti", "training", "velodyne").glob("*.bin"))[0]
    real = torch.from_numpy(np.fromfile(path, np.float32).reshape(-1, 4))
    points = torch.cat((fan(8000, torch.Generator().manual_seed(1)), real))
    sample = (torch.arange(len(points)) >= 8000).long()
    index = voxelize(points, sample, 2, GRID).index
    assert np.array_equal(by_bits(index, CELL, radius).numpy(), by_tree(index, CELL, radius))


def test_numba_ball_count_does_not_depend_on_threads():
    index = random_index(2000, torch.Generator().manual_seed(7))
    before = torch.get_num_threads()
    counts = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        counts.append(by_bits(index, CELL, 0.6))
    torch.set_num_threads(before)
    assert torch.equal(*counts)


def test_ball_count_of_nothing_and_what_is_wrong():
    assert ball_count(torch.zeros(0, 4, dtype=torch.int64), CELL, 0.6).shape == (0,)
    assert ball_counts(torch.zeros(0, 4, dtype=torch.int64), CELL, (0.6, 1.8)).shape == (0, 2)
    with pytest.raises(BeamboxError, match=r"must be positive, got -1 and \(0.1, 0.1, 0.15\)"):
        ball_count(torch.zeros(1, 4, dtype=torch.int64), CELL, -1)
    with pytest.raises(BeamboxError, match=r"`index` must have shape \(any, 4\), got \(2, 3\)"):
        ball_count(torch.zeros(2, 3, dtype=torch.int64), CELL, 0.6)
