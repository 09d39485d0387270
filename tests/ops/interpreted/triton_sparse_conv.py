"""The Triton kernels of sparse convolution, on a GPU or through Triton's interpreter (see test_triton.py)."""

import pytest
import torch

from beambox.ops.sparse_conv import ConvSpec, SparseTensor, gpu, kernel_map, reference
from oracles.sparse_conv import random_sparse

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
GEOMETRIES = (ConvSpec.centered((3, 3, 3)), ConvSpec((3, 1, 2), (2, 1, 2), (0, 0, 1)))


def on_device(x: SparseTensor) -> SparseTensor:
    return SparseTensor.of(x.features.to(DEVICE), x.indices.to(DEVICE), x.shape, x.batch_size)


@pytest.mark.parametrize("spec", GEOMETRIES, ids=["centred", "strided"])
@pytest.mark.parametrize(
    ("density", "c_in", "c_out"), [(0.4, 5, 7), (0.1, 1, 20), (0.0, 4, 4)], ids=["odd", "thin", "empty"]
)
def test_convolution_and_gradients_equal_reference(spec, density, c_in, c_out):
    x = on_device(random_sparse(1, (3, 4, 5), 2, density, c_in, torch.float32))
    pairs = kernel_map(x.sites, spec)
    generator = torch.Generator().manual_seed(2)
    weight = torch.randn((spec.offsets, c_in, c_out), generator=generator).to(DEVICE)
    bias = torch.randn(c_out, generator=generator).to(DEVICE)
    cotangent = torch.randn((len(pairs.target), c_out), generator=generator).to(DEVICE)
    for kernel_map_, values in ((pairs, x.features), (pairs.inverse, cotangent)):
        w = weight if kernel_map_ is pairs else weight.transpose(1, 2).contiguous()
        b = bias if kernel_map_ is pairs else None
        ours, theirs = ([t.detach().clone().requires_grad_() for t in (values, w)] for _ in range(2))
        actual = gpu.convolve(ours[0], ours[1], b, kernel_map_)
        want = reference.convolve(theirs[0], theirs[1], b, kernel_map_)
        torch.testing.assert_close(actual, want, rtol=1e-4, atol=1e-5)
        direction = torch.randn(want.shape, generator=generator).to(DEVICE)
        for mine, other in zip(
            torch.autograd.grad((actual * direction).sum(), ours), torch.autograd.grad((want * direction).sum(), theirs)
        ):
            torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4)


def test_half_precision_stays_half_and_adds_in_float32():
    x = on_device(random_sparse(3, (3, 4, 5), 1, 0.5, 8, torch.float32))
    pairs = kernel_map(x.sites, GEOMETRIES[0])
    weight = torch.randn((27, 8, 8), generator=torch.Generator().manual_seed(4)).to(DEVICE)
    actual = gpu.convolve(x.features.half(), weight.half(), None, pairs)
    assert actual.dtype == torch.float16
    want = reference.convolve(x.features, weight, None, pairs)
    torch.testing.assert_close(actual.float(), want, rtol=2e-2, atol=2e-2)
