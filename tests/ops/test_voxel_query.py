"""Voxel query against plain loops."""

from __future__ import annotations

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.ops.sparse_conv import Sites
from beambox.ops.voxel_query import voxel_query
from oracles.sparse_conv import random_sparse
from oracles.voxel_query import query_by_loops

CELL = torch.tensor([0.5, 0.4, 0.3], dtype=torch.float64)  # x, y, z


@pytest.fixture(params=["reference", "numba"])
def backend(request, monkeypatch):
    """Run with each backend in turn."""
    monkeypatch.setenv("BEAMBOX_BACKEND", request.param)
    return request.param


def scene(seed: int, density: float, count: int = 40):
    """Draw voxels and points, some outside the grid."""
    sites = random_sparse(seed, (5, 6, 20), 2, density, 1).sites
    centers = (sites.indices[:, 1:].flip(1) + 0.5) * CELL
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand((count, 3), generator=generator, dtype=torch.float64) * torch.tensor([11.0, 3.4, 2.5]) - 0.5
    sample = torch.randint(2, (count, 1), generator=generator)
    cells = torch.cat((sample, torch.floor(points / CELL).long().flip(1)), dim=1)
    return points, cells, sites, centers


@pytest.mark.parametrize("max_samples", [1, 3, 16])
@pytest.mark.parametrize(
    ("query_range", "radius"), [((2, 2, 2), 0.8), ((0, 1, 4), 1.5), ((4, 4, 4), 0.45), ((0, 0, 0), 9.0)]
)
@pytest.mark.parametrize("density", [0.02, 0.3, 1.0])
def test_voxel_query_visits_what_loops_visit(backend, density, query_range, radius, max_samples):
    points, cells, sites, centers = scene(1, density)
    found = voxel_query(points, cells, sites, centers, query_range, radius, max_samples)
    assert found.tolist() == query_by_loops(points, cells, sites, centers, query_range, radius, max_samples).tolist()


def test_voxel_query_of_nothing(backend):
    points, cells, sites, centers = scene(2, 0.3)
    nothing = Sites.of(torch.zeros(0, 4, dtype=torch.int64), sites.shape, 2)
    assert voxel_query(points, cells, nothing, centers[:0], (1, 1, 1), 1.0, 4).eq(-1).all()
    assert voxel_query(points[:0], cells[:0], sites, centers, (1, 1, 1), 1.0, 4).shape == (0, 4)


def test_voxel_query_far_outside_finds_nothing(backend):
    """A point that is NaN or infinite has the smallest or the largest integer as its cell."""
    points, _, sites, centers = scene(4, 1.0, count=7)
    least, most = torch.iinfo(torch.int64).min, torch.iinfo(torch.int64).max
    cells = torch.tensor([[b, z, y, x] for b in (0, 1) for z, y, x in ((least,) * 3, (most,) * 3, (2, least, most))])
    cells = torch.cat((cells, torch.tensor([[most, 2, 2, 2]])))
    assert voxel_query(points, cells, sites, centers, (2, 2, 2), 100.0, 4).eq(-1).all()


def test_voxel_query_refuses_what_makes_no_sense():
    points, cells, sites, centers = scene(3, 0.3)
    with pytest.raises(BeamboxError, match="positive radius and at least 1 sample"):
        voxel_query(points, cells, sites, centers, (1, 1, 1), 0.0, 4)
    with pytest.raises(BeamboxError, match=r"`centers` must have shape"):
        voxel_query(points, cells, sites, centers[:1], (1, 1, 1), 1.0, 4)
