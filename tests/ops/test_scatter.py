"""Segment reductions and maps: against plain loops, numba against the reference, every gradient."""

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.ops.scatter import cpu, graph, reference, scatter_bev, segment_max, segment_mean, segment_sum
from oracles import loops

MAX_VERSIONS = pytest.mark.parametrize("version", [reference.segment_max, cpu.segment_max], ids=["reference", "numba"])
SIZES = pytest.mark.parametrize(("rows", "columns", "size"), [(0, 3, 4), (1, 1, 1), (40, 7, 13), (50, 2, 1), (0, 5, 0)])


def case(rows, columns, size, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(rows, columns, generator=generator, dtype=dtype)
    values = torch.where(torch.rand(rows, columns, generator=generator) < 0.3, 0.5, values)  # ties
    return values, torch.randint(0, max(size, 1), (rows,), generator=generator)


@SIZES
@pytest.mark.parametrize(
    ("operation", "reduce"),
    [(segment_sum, sum), (segment_mean, np.mean), (segment_max, max)],
    ids=["sum", "mean", "max"],
)
def test_segments_agree_with_plain_loop(operation, reduce, rows, columns, size):
    values, segment = case(rows, columns, size)
    want = loops.segment(values.numpy(), segment.numpy(), size, reduce)
    np.testing.assert_allclose(operation(values, segment, size).numpy(), want, rtol=1e-12, atol=1e-12)


@SIZES
@pytest.mark.parametrize("name", ["segment_sum", "segment_mean", "segment_max"])
def test_versions_for_graphs_equal_the_reference(name, rows, columns, size):
    values, segment = case(rows, columns, size)
    want = vars(reference)[name](values, segment, size)
    torch.testing.assert_close(vars(graph)[name](values, segment, size), want, rtol=1e-12, atol=1e-12)


def test_the_map_for_graphs_equals_the_reference():
    index = torch.tensor([[0, 0, 1, 2], [1, 0, 0, 3], [0, 1, 1, 2]])
    features = torch.arange(6.0).view(3, 2)
    want = reference.scatter_bev(features, index, 2, (3, 4))
    assert torch.equal(graph.scatter_bev(features, index, 2, (3, 4)), want)


@SIZES
@pytest.mark.parametrize("operation", [segment_sum, segment_mean], ids=["sum", "mean"])
def test_segment_gradients(operation, rows, columns, size):
    values, segment = case(rows, columns, size)
    values.requires_grad_()
    assert torch.autograd.gradcheck(lambda v: operation(v, segment, size), values)


@MAX_VERSIONS
def test_segment_max_gradient(version):
    values, segment = case(40, 7, 13)
    values = (torch.arange(280, dtype=torch.float64).view(40, 7) * 37 % 281).requires_grad_()  # no ties
    assert torch.autograd.gradcheck(lambda v: version(v, segment, 13), values)


@MAX_VERSIONS
def test_segment_max_gradient_goes_to_the_first_of_equals(version):
    values = torch.tensor([[1.0, 2.0], [1.0, 3.0], [0.0, 3.0]], requires_grad=True)
    version(values, torch.tensor([1, 1, 1]), 2).sum().backward()
    assert values.grad.tolist() == [[1, 0], [0, 1], [0, 0]]


@MAX_VERSIONS
def test_segment_max_shows_nan_and_takes_infinities(version):
    inf, nan = torch.inf, torch.nan
    values = torch.tensor([[1.0, -inf, inf, nan], [nan, -inf, 5.0, inf], [7.0, -inf, nan, 1.0]], requires_grad=True)
    out = version(values, torch.tensor([0, 0, 0]), 1)
    torch.testing.assert_close(out, torch.tensor([[nan, -inf, inf, nan]]), equal_nan=True)
    out.backward(torch.ones_like(out))
    assert values.grad.tolist() == [[0, 1, 1, 1], [1, 0, 0, 0], [0, 0, 0, 0]]


@SIZES
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numba_segment_max_equals_reference(rows, columns, size, dtype):
    values, segment = case(rows, columns, size, dtype, seed=rows)
    ours, theirs = values.clone().requires_grad_(), values.clone().requires_grad_()
    actual, want = cpu.segment_max(ours, segment, size), reference.segment_max(theirs, segment, size)
    assert torch.equal(actual, want)
    cotangent = torch.randn(actual.shape, generator=torch.Generator().manual_seed(1), dtype=dtype)
    actual.backward(cotangent)
    want.backward(cotangent)
    assert torch.equal(ours.grad, theirs.grad)


def test_half_precision_runs_on_the_reference():
    values, segment = case(10, 3, 4, torch.float32)
    half = segment_max(values.bfloat16(), segment, 4)
    assert half.dtype == torch.bfloat16
    assert torch.equal(half, segment_max(values.bfloat16().float(), segment, 4).bfloat16())


def test_scatter_bev_places_each_voxel_at_its_row_and_column():
    features = torch.arange(1.0, 7.0).view(3, 2).requires_grad_()
    index = torch.tensor([[0, 0, 1, 2], [1, 0, 0, 0], [1, 3, 2, 3]])
    bev = scatter_bev(features, index, 2, (3, 4))
    want = torch.zeros(2, 2, 3, 4)
    want[0, :, 1, 2], want[1, :, 0, 0], want[1, :, 2, 3] = features.detach()
    assert torch.equal(bev, want)
    (bev * torch.arange(48.0).view(2, 2, 3, 4)).sum().backward()
    assert features.grad.tolist() == [[6, 18], [24, 36], [35, 47]]


def test_scatter_bev_adds_voxels_above_each_other_and_takes_none():
    index = torch.tensor([[0, 0, 1, 1], [0, 5, 1, 1]])
    assert scatter_bev(torch.ones(2, 3), index, 1, (2, 2))[0, :, 1, 1].tolist() == [2, 2, 2]
    assert scatter_bev(torch.ones(0, 3), index[:0], 2, (2, 5)).shape == (2, 3, 2, 5)


def test_scatter_tells_what_is_wrong():
    values, segment = torch.zeros(3, 2), torch.tensor([0, 1, 2])
    with pytest.raises(BeamboxError, match=r"`segment` must lie in 0 .. 1 \(size 2\), got 0 .. 2"):
        segment_sum(values, segment, 2)
    with pytest.raises(BeamboxError, match=r"`values` must be floating point, got int64"):
        segment_max(values.long(), segment, 3)
    with pytest.raises(BeamboxError, match=r"`values` has 3, `segment` has 2"):
        segment_mean(values, segment[:2], 3)
    with pytest.raises(
        BeamboxError, match=r"`index` .* must lie below \(1, any, 2, 2\) and not below 0, got .* \(0, 0, 2, 0\)"
    ):
        scatter_bev(torch.zeros(1, 2), torch.tensor([[0, 0, 2, 0]]), 1, (2, 2))
