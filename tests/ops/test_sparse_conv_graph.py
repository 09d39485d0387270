"""What runs in an exported graph computes what the reference computes: sites, rows, sums, maps."""

from __future__ import annotations

import pytest
import torch

from beambox.ops.sparse_conv import (
    ConvSpec,
    KernelMap,
    Sites,
    SparseTensor,
    graph,
    graph_indices,
    graph_maps,
    reference,
)

SPECS = {
    "submanifold": ConvSpec.centered((3, 3, 3)),
    "wide": ConvSpec.centered((3, 5, 1)),
    "dilated": ConvSpec.centered((3, 3, 3), (1, 1, 2)),
    "halving": ConvSpec((3, 3, 3), (2, 2, 2), (1, 1, 1)),
    "halving without padding above": ConvSpec((3, 3, 3), (2, 2, 2), (0, 1, 1)),
    "height": ConvSpec((3, 1, 1), (2, 1, 1)),
}


def scattered(shape: tuple[int, int, int], count: int, seed: int) -> Sites:
    """Sites in no order, some on the borders."""
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randint(0, 2 * shape[0] * shape[1] * shape[2], (count,), generator=generator)
    keys = torch.unique(cells)[torch.randperm(len(torch.unique(cells)), generator=generator)]
    z, y, x = shape
    return Sites.of(torch.stack((keys // (z * y * x), keys // (y * x) % z, keys // x % y, keys % x), dim=1), shape, 2)


@pytest.mark.parametrize("most_in_map", [0, 1 << 24], ids=["searched", "looked up"])
@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("count", [1, 2, 300])
def test_tables_sites_and_sums_are_those_of_the_reference(
    name: str, count: int, most_in_map: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph_maps, "MAP_CELLS", most_in_map)
    spec, sites = SPECS[name], scattered((7, 10, 9), count, seed=count)
    target = sites
    if not spec.submanifold:
        keys = graph_maps.find_targets(sites, spec)
        assert torch.equal(keys, reference.find_targets(sites, spec))
        target = Sites.from_keys(keys, spec.output_shape(sites.shape), 2)
    wanted = reference.neighbor_table(sites, target, spec)
    assert torch.equal(graph_maps.neighbor_table(sites, target, spec).int(), wanted)
    pairs = KernelMap(sites, target, spec)
    features, weight = torch.randn(len(sites), 5), torch.randn(spec.offsets, 5, 3)
    for bias in (None, torch.randn(3)):
        torch.testing.assert_close(
            graph.convolve(features, weight, bias, pairs), reference.convolve(features, weight, bias, pairs)
        )


def test_indices_and_maps_are_those_of_a_sparse_tensor() -> None:
    sites = scattered((3, 5, 4), 40, seed=1)
    features = torch.randn(len(sites), 6)
    assert torch.equal(graph_indices.indices_of(sites.sorted_keys, sites.order, sites.shape), sites.indices)
    assert torch.equal(
        graph_indices.to_bev(features, sites.indices, sites.shape, 2), SparseTensor(features, sites).to_bev()
    )


def test_the_search_finds_the_first_place_that_is_not_below() -> None:
    values = torch.tensor([3, 4, 9, 70, 0, 5, -1])  # two lines, from 0 to 4 and from 4 to 6
    begin, end = torch.tensor([0, 0, 0, 0, 0, 4, 4, 4, 6]), torch.tensor([4, 4, 4, 4, 4, 6, 6, 6, 6])
    wanted = torch.tensor([0, 3, 5, 70, 71, 0, 5, 6, 1])
    assert graph_maps.lower_bound(values, begin, end, wanted, 3).tolist() == [0, 0, 2, 3, 4, 4, 5, 6, 6]
