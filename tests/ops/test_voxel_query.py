"""Voxel query against plain loops."""

from __future__ import annotations

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.ops.sparse_conv import Sites
from beambox.ops.voxel_query import pooled_query, voxel_query
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


@pytest.mark.parametrize("channels", [1, 7, 32])
@pytest.mark.parametrize("density", [0.02, 0.3])
def test_pooling_at_once_is_search_gather_and_maximum(backend, density, channels):
    points, cells, sites, centers = scene(3, density)
    torch.manual_seed(channels)
    features, weight, bias = torch.randn(len(sites), channels), torch.randn(channels, 3), torch.randn(channels)
    where = (points.float(), cells, sites, centers.float(), (2, 2, 2), 0.8, 5)
    ours = pooled_query(*where, features, weight, bias)
    found = voxel_query(*where)
    assert (found < 0).any() and (found >= 0).any()
    for m, rows in enumerate(found.tolist()):
        values = [features[v] + weight @ (where[3][v] - where[0][m]) + bias for v in rows if v >= 0] or [bias]
        torch.testing.assert_close(ours[m], torch.stack(values).amax(0).relu(), rtol=0, atol=1e-5)


def test_pooling_nothing_gives_the_bias(backend):
    points, cells, sites, centers = scene(0, 0.0)
    out = pooled_query(
        points.float(), cells, sites, centers.float(), (1, 1, 1), 1.0, 2, torch.zeros(len(sites), 3), torch.ones(3, 3),
        torch.tensor([-1.0, 0.0, 2.0]),
    )  # fmt: skip
    assert len(sites) == 0 and torch.equal(out, torch.tensor([0.0, 0.0, 2.0]).expand(len(points), 3))


def test_pooling_keeps_a_nan_and_gives_gradients(backend):
    points, cells, sites, centers = scene(3, 0.3)
    features = torch.randn(len(sites), 4)
    features[:, 2] = torch.nan
    where = (points.float(), cells, sites, centers.float(), (2, 2, 2), 0.8, 5)
    weight = torch.randn(4, 3)
    some = (voxel_query(*where) >= 0).any(dim=1)
    assert pooled_query(*where, features, weight, torch.zeros(4))[some][:, 2].isnan().all()
    weight.requires_grad_()
    pooled_query(*where, features.nan_to_num(1.0), weight, torch.zeros(4)).sum().backward()
    assert weight.grad is not None and weight.grad.abs().sum() > 0
