"""Sparse convolution against dense conv3d at the active sites, forward and every gradient."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from beambox.checks import BeamboxError
from beambox.ops.sparse_conv import (
    ConvSpec,
    Sites,
    SparseTensor,
    inverse_conv3d,
    kernel_map,
    sparse_conv3d,
    submanifold_conv3d,
)
from oracles.sparse_conv import dense_weight, random_sparse, read_at

STRIDED = [  # kernel, stride, padding, dilation
    ((3, 3, 3), (2, 2, 2), (1, 1, 1), (1, 1, 1)),
    ((3, 3, 3), (2, 2, 2), (0, 1, 1), (1, 1, 1)),
    ((3, 1, 1), (2, 1, 1), (0, 0, 0), (1, 1, 1)),
    ((2, 2, 2), (2, 2, 2), (0, 0, 0), (1, 1, 1)),
    ((1, 1, 1), (1, 1, 1), (0, 0, 0), (1, 1, 1)),
    ((3, 3, 3), (1, 1, 1), (2, 2, 2), (2, 2, 2)),
    ((2, 3, 4), (3, 1, 2), (1, 2, 0), (1, 2, 1)),
    ((1, 3, 5), (1, 2, 3), (0, 3, 2), (1, 1, 1)),
]
CENTERED = [  # kernel, dilation
    ((3, 3, 3), (1, 1, 1)),
    ((3, 3, 3), (1, 2, 2)),
    ((1, 3, 3), (1, 1, 1)),
    ((5, 3, 1), (1, 1, 1)),
    ((1, 1, 1), (1, 1, 1)),
]
INPUTS = [  # density, batch size, channels in and out
    (0.05, 1, 4, 16),
    (0.3, 2, 7, 13),
    (1.0, 3, 1, 1),
]
TOLERANCE = {torch.float64: 1e-10, torch.float32: 1e-5}


@pytest.fixture(params=["reference", "numba"])
def backend(request, monkeypatch):
    """Run with each backend in turn."""
    monkeypatch.setenv("BEAMBOX_BACKEND", request.param)
    return request.param


def close(ours: torch.Tensor, theirs: torch.Tensor) -> None:
    scale = max(1.0, float(theirs.detach().abs().max())) if theirs.numel() else 1.0
    torch.testing.assert_close(ours, theirs, rtol=0, atol=TOLERANCE[theirs.dtype] * scale)


def compare(ours, dense, x, weight, bias) -> None:
    """Check outputs, and the gradients of a random functional of them, against the dense computation."""
    leaves = [x.features.clone().requires_grad_(), weight.clone().requires_grad_(), bias.clone().requires_grad_()]
    out = ours(x.with_features(leaves[0]), leaves[1], leaves[2])
    twins = [leaf.detach().clone().requires_grad_() for leaf in leaves]
    expected = read_at(dense(x.with_features(twins[0]).to_dense(), dense_weight(twins[1]), twins[2]), out.indices)
    close(out.features, expected)
    direction = torch.randn(expected.shape, generator=torch.Generator().manual_seed(5), dtype=expected.dtype)
    found = torch.autograd.grad((out.features * direction).sum(), leaves)
    wanted = torch.autograd.grad((expected * direction).sum(), twins)
    for name, ours_grad, dense_grad in zip(("input", "weight", "bias"), found, wanted):
        try:
            close(ours_grad, dense_grad)
        except AssertionError as error:
            raise AssertionError(f"gradient of the {name}: {error}") from error


def parameters(kernel, c_in, c_out, dtype):
    generator = torch.Generator().manual_seed(3)
    weight = torch.randn((*kernel, c_in, c_out), generator=generator, dtype=dtype) / (c_in * 9) ** 0.5
    return weight, torch.randn(c_out, generator=generator, dtype=dtype)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize(("density", "batch", "c_in", "c_out"), INPUTS)
@pytest.mark.parametrize(("kernel", "stride", "padding", "dilation"), STRIDED)
def test_sparse_conv_matches_dense(backend, kernel, stride, padding, dilation, density, batch, c_in, c_out, dtype):
    x = random_sparse(1, (7, 9, 8), batch, density, c_in, dtype)
    weight, bias = parameters(kernel, c_in, c_out, dtype)
    compare(
        lambda x, w, b: sparse_conv3d(x, w, b, stride, padding, dilation),
        lambda x, w, b: F.conv3d(x, w, b, stride, padding, dilation),
        x,
        weight,
        bias,
    )


@pytest.mark.parametrize(("density", "batch", "c_in", "c_out"), INPUTS)
@pytest.mark.parametrize(("kernel", "stride", "padding", "dilation"), STRIDED)
def test_sparse_conv_activates_exactly_what_an_active_input_reaches(
    backend, kernel, stride, padding, dilation, density, batch, c_in, c_out
):
    x = random_sparse(2, (7, 9, 8), batch, density, 1)
    occupied = x.with_features(torch.ones_like(x.features)).to_dense()
    reached = F.conv3d(occupied, torch.ones((1, 1, *kernel)).double(), None, stride, padding, dilation)[:, 0] > 0
    out = kernel_map(x.sites, ConvSpec(kernel, stride, padding, dilation)).target
    assert out.indices.equal(torch.nonzero(reached))
    assert out.shape == tuple(reached.shape[1:])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize(("density", "batch", "c_in", "c_out"), INPUTS)
@pytest.mark.parametrize(("kernel", "dilation"), CENTERED)
def test_submanifold_conv_matches_dense(backend, kernel, dilation, density, batch, c_in, c_out, dtype):
    x = random_sparse(3, (7, 9, 8), batch, density, c_in, dtype)
    weight, bias = parameters(kernel, c_in, c_out, dtype)
    padding = tuple(d * (k // 2) for k, d in zip(kernel, dilation))
    compare(
        lambda x, w, b: submanifold_conv3d(x, w, b, dilation),
        lambda x, w, b: F.conv3d(x, w, b, 1, padding, dilation),
        x,
        weight,
        bias,
    )
    assert submanifold_conv3d(x, weight).sites is x.sites


@pytest.mark.parametrize(("kernel", "stride", "padding", "dilation"), STRIDED)
def test_inverse_conv_matches_dense_transposed_conv(backend, kernel, stride, padding, dilation):
    fine = random_sparse(4, (7, 9, 8), 2, 0.2, 3)
    weight, bias = parameters(kernel, 5, 4, torch.float64)
    coarse_sites = kernel_map(fine.sites, ConvSpec(kernel, stride, padding, dilation)).target
    coarse = SparseTensor(torch.randn(len(coarse_sites), 5, dtype=torch.float64), coarse_sites)

    def dense(x, w, b):
        covered = [
            (n - 1) * s - 2 * p + d * (k - 1) + 1
            for n, k, s, p, d in zip(coarse.shape, kernel, stride, padding, dilation)
        ]
        rest = [n - c for n, c in zip(fine.shape, covered)]
        return F.conv_transpose3d(x, w.transpose(0, 1), b, stride, padding, rest, 1, dilation)

    compare(lambda x, w, b: inverse_conv3d(x, w, fine.sites, b, stride, padding, dilation), dense, coarse, weight, bias)


def test_inverse_conv_refuses_sites_it_did_not_make():
    fine, other = random_sparse(5), random_sparse(6, density=0.1)
    weight = torch.randn(3, 3, 3, 3, 2, dtype=torch.float64)
    with pytest.raises(BeamboxError, match="give the same kernel, stride, padding and dilation"):
        inverse_conv3d(other, weight, fine.sites, stride=(2, 2, 2))


def test_layers_on_the_same_sites_share_one_map():
    x = random_sparse(7)
    weight = torch.randn(3, 3, 3, 3, 3, dtype=torch.float64)
    once = submanifold_conv3d(x, weight)
    submanifold_conv3d(once, weight)
    assert list(x.sites.maps) == [ConvSpec.centered((3, 3, 3))]


@pytest.mark.parametrize("empty", [(0,), (1,), (0, 1)])
def test_empty_samples_give_what_dense_gives(backend, empty):
    x = random_sparse(8, empty=empty)
    weight, bias = parameters((3, 3, 3), 3, 4, torch.float64)
    out = sparse_conv3d(x, weight, bias, (2, 2, 2), (1, 1, 1))
    assert out.batch_size == 2
    assert not set(out.indices[:, 0].tolist()) & set(empty)
    compare(
        lambda x, w, b: sparse_conv3d(x, w, b, (2, 2, 2), (1, 1, 1)),
        lambda x, w, b: F.conv3d(x, w, b, 2, 1),
        x,
        weight,
        bias,
    )
    compare(submanifold_conv3d, lambda x, w, b: F.conv3d(x, w, b, 1, 1), x, weight, bias)
    assert out.to_dense().shape == (2, 4, 3, 4, 3)


def test_a_single_voxel_sees_the_center_of_the_kernel_only():
    x = SparseTensor.of(torch.tensor([[2.0]]), torch.tensor([[0, 1, 1, 1]]), (3, 3, 3), 1)
    weight = torch.arange(27.0).reshape(3, 3, 3, 1, 1)
    assert submanifold_conv3d(x, weight).features.tolist() == [[26.0]]


def test_repeated_sites_are_refused_with_the_first():
    with pytest.raises(BeamboxError, match=r"1 repeated, first \(b, z, y, x\) = \[0, 1, 2, 3\].*voxelize"):
        Sites.of(torch.tensor([[0, 1, 2, 3], [0, 0, 0, 0], [0, 1, 2, 3]]), (4, 4, 4), 1)


@pytest.mark.parametrize("bad", [[0, 4, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
def test_sites_outside_the_grid_are_refused(bad):
    with pytest.raises(BeamboxError, match=r"must lie in \[0, \(1, 4, 4, 4\)\)"):
        Sites.of(torch.tensor([bad]), (4, 4, 4), 1)


def test_wrong_shapes_are_refused():
    x = random_sparse(9, channels=3)
    with pytest.raises(BeamboxError, match=r"`weight` must have shape \(kz, ky, kx, 3, C_out\), got \(3, 3, 3, 4, 5\)"):
        submanifold_conv3d(x, torch.zeros(3, 3, 3, 4, 5))
    with pytest.raises(BeamboxError, match="odd kernel sizes"):
        submanifold_conv3d(x, torch.zeros(2, 3, 3, 3, 5))
    with pytest.raises(BeamboxError, match="does not fit an input"):
        sparse_conv3d(x, torch.zeros(9, 3, 3, 3, 5).double())
    with pytest.raises(BeamboxError, match="one row a site"):
        x.with_features(torch.zeros(1, 3))


def test_bev_channel_is_feature_times_depth_plus_level():
    x = SparseTensor.of(torch.tensor([[1.0, 2.0]]), torch.tensor([[0, 1, 2, 3]]), (2, 4, 5), 1)
    bev = x.to_bev()
    assert bev.shape == (1, 4, 4, 5)
    assert bev[0, :, 2, 3].tolist() == [0.0, 1.0, 0.0, 2.0]
    assert bev.sum() == 3


def test_sorting_keeps_the_tensor():
    x = random_sparse(10)
    assert x.sorted().to_dense().equal(x.to_dense())
    assert x.sorted().sites.sorted_keys.diff().gt(0).all()


@pytest.mark.parametrize(("shape", "chain"), [((41, 32, 32), [21, 11, 5, 2]), ((28, 32, 32), [14, 7, 3, 1])])
def test_height_chain_of_the_eightfold_backbone(shape, chain):
    heights = []
    for spec in (
        ConvSpec((3, 3, 3), (2, 2, 2), (1, 1, 1)),
        ConvSpec((3, 3, 3), (2, 2, 2), (1, 1, 1)),
        ConvSpec((3, 3, 3), (2, 2, 2), (0, 1, 1)),
        ConvSpec((3, 1, 1), (2, 1, 1)),
    ):
        shape = spec.output_shape(shape)
        heights.append(shape[0])
    assert heights == chain


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=["bfloat16", "float16"])
def test_half_precision_stays_half_and_close(backend, dtype):
    x = random_sparse(12, (7, 9, 40), 2, 0.3, 8, torch.float32)
    weight, bias = parameters((3, 3, 3), 8, 6, torch.float32)
    direction = torch.randn(len(x.sites), 6, generator=torch.Generator().manual_seed(1))

    def run(kind):
        leaves = [t.to(kind).requires_grad_() for t in (x.features.clone(), weight.clone(), bias.clone())]
        out = submanifold_conv3d(x.with_features(leaves[0]), leaves[1], leaves[2]).features
        return [out, *torch.autograd.grad((out * direction.to(kind)).sum(), leaves)]

    for half, full in zip(run(dtype), run(torch.float32)):
        assert half.dtype == dtype
        torch.testing.assert_close(half.float(), full, rtol=0, atol=0.02 * float(full.detach().abs().max()))


def test_autocast_gives_what_the_processor_is_good_at():
    x = random_sparse(13, channels=4, dtype=torch.float32)
    weight, _ = parameters((3, 3, 3), 4, 4, torch.float32)
    plain = submanifold_conv3d(x, weight).features
    with torch.autocast("cpu", torch.bfloat16):
        cast = submanifold_conv3d(x, weight).features
    assert cast.dtype in (torch.bfloat16, torch.float32)
    torch.testing.assert_close(cast.float(), plain, rtol=0, atol=0.05)


def many_threads_agree(repetitions: int) -> None:
    """Run one network's worth of layers again and again on 1, 2 and 4 threads and compare every bit."""
    x = random_sparse(11, (11, 40, 40), 2, 0.1, 16, torch.float32)
    weights = [parameters(k, i, o, torch.float32) for k, i, o in (((3, 3, 3), 16, 32), ((3, 3, 3), 32, 20))]

    def run():
        leaves = [x.features.clone().requires_grad_(), *(w.clone().requires_grad_() for pair in weights for w in pair)]
        fresh = SparseTensor.of(leaves[0], x.indices, x.shape, x.batch_size)
        out = sparse_conv3d(fresh, leaves[1], leaves[2], (2, 2, 2), (1, 1, 1))
        out = submanifold_conv3d(out, leaves[3], leaves[4])
        grads = torch.autograd.grad((out.features**2).sum(), leaves)
        return [out.features.detach(), out.indices, *grads]

    before = torch.get_num_threads()
    try:
        first = run()
        for repetition in range(repetitions):
            torch.set_num_threads((1, 2, 4)[repetition % 3])
            for expected, found in zip(first, run()):
                assert expected.equal(found)
    finally:
        torch.set_num_threads(before)


def test_bits_do_not_depend_on_threads():
    many_threads_agree(6)


@pytest.mark.slow
def test_bits_do_not_depend_on_threads_in_200_repetitions():
    many_threads_agree(200)
