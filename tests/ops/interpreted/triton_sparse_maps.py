"""Triton kernels of kernel maps and voxel queries, on a GPU or through Triton's interpreter (see test_triton.py)."""

import pytest
import torch

from beambox.ops import sparse_conv
from beambox.ops.sparse_conv import ConvSpec, Sites, find_chain, gpu_maps, kernel_map, reference
from beambox.ops.sparse_conv.pairs import input_rows
from beambox.ops.sparse_conv.sites import indices_of
from beambox.ops.voxel_query import reference as plain_query
from beambox.ops.voxel_query import voxel_query
from oracles.sparse_conv import random_sparse

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
GEOMETRIES = (
    ConvSpec.centered((3, 3, 3)),
    ConvSpec.centered((1, 3, 3), (1, 2, 1)),
    ConvSpec((3, 3, 3), (2, 2, 2), (1, 1, 1)),
    ConvSpec((3, 1, 2), (2, 1, 2), (0, 0, 1)),
    ConvSpec((2, 2, 1), (3, 1, 2), (1, 0, 1), (2, 3, 1)),
)


def sites_of(seed, shape=(4, 5, 6), density=0.15, empty=()):
    x = random_sparse(seed, shape, 3, density, 1, torch.float32, empty)
    return Sites.of(x.indices.to(DEVICE), x.shape, x.batch_size)


@pytest.mark.parametrize("spec", GEOMETRIES, ids=str)
@pytest.mark.parametrize(("density", "empty"), [(0.15, ()), (1.0, (0,)), (0.0, ())])
def test_maps_equal_reference(spec, density, empty):
    sites = sites_of(1, density=density, empty=empty)
    assert sites.indices.equal(indices_of(sites.sorted_keys, sites.order, sites.shape))
    found = kernel_map(sites, spec)
    if not spec.submanifold:
        assert found.target.sorted_keys.equal(reference.find_targets(sites, spec))
    table = reference.neighbor_table(sites, found.target, spec)
    assert found.kept(input_rows).equal(table)
    assert gpu_maps.inverse_table(table, len(sites)).equal(reference.inverse_table(table, len(sites)))


def test_a_chain_is_what_its_links_are():
    chain = (GEOMETRIES[2], ConvSpec((3, 3, 3), (2, 2, 2), (0, 1, 1)), ConvSpec((3, 1, 1), (2, 1, 1)))
    one, other = (sites_of(2, (15, 8, 6), 0.05) for _ in range(2))
    find_chain(one, chain)
    for spec in chain:
        assert list(one.maps) == [spec]
        kept, link = one.maps[spec], kernel_map(other, spec)
        assert kept.target.shape == link.target.shape
        assert kept.target.sorted_keys.equal(reference.find_targets(other, spec))
        one, other = kept.target, link.target


def test_a_level_too_large_for_a_map_is_sorted(monkeypatch):
    monkeypatch.setattr(sparse_conv, "MOST_CELLS", 10)
    sites = sites_of(3)
    find_chain(sites, GEOMETRIES[2:3])
    assert not sites.maps
    assert kernel_map(sites, GEOMETRIES[2]).target.sorted_keys.equal(reference.find_targets(sites, GEOMETRIES[2]))


@pytest.mark.parametrize(
    ("density", "reach", "radius", "samples"),
    [
        (0.3, (2, 1, 2), 0.8, 3),
        (0.1, (0, 1, 4), 1.5, 16),
        (1.0, (2, 2, 3), 0.45, 5),
        (1.0, (0, 0, 0), 9.0, 1),
        (0.0, (1, 1, 1), 9.0, 4),
    ],
)
def test_voxel_query_equals_reference(density, reach, radius, samples):
    sites = sites_of(4, (5, 6, 20), density)
    size = torch.tensor([0.5, 0.4, 0.3], dtype=torch.float64, device=DEVICE)
    centers = (sites.indices[:, 1:].flip(1) + 0.5) * size
    generator = torch.Generator().manual_seed(5)
    points = (torch.rand((70, 3), generator=generator, dtype=torch.float64).to(DEVICE) * 11 - 0.5) * size * 2
    sample = torch.randint(3, (70, 1), generator=generator).to(DEVICE)
    cells = torch.cat((sample, torch.floor(points / size).long().flip(1)), dim=1)
    least, most = torch.iinfo(torch.int64).min, torch.iinfo(torch.int64).max
    cells[:3] = torch.tensor([[0, least, least, least], [1, most, most, most], [most, 2, 2, 2]], device=DEVICE)
    given = (points, cells, sites, centers, reach, radius, samples)
    assert voxel_query(*given).equal(plain_query.voxel_query(*given))
