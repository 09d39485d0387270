"""Neighbourhood attention: reference against plain loops, numba against the reference, every gradient."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.ops.neighborhood import cpu, neighborhood_attention, reference
from beambox.ops.neighborhood.windows import queries_of, window_start
from oracles import neighborhood as attention
from oracles.paths import ROOT

VERSIONS = pytest.mark.parametrize(
    "version", [reference.neighborhood_attention, cpu.neighborhood_attention], ids=["reference", "numba"]
)
SHAPES = pytest.mark.parametrize(
    ("shape", "window"),
    [((1, 1, 7, 7, 1), 7), ((2, 2, 9, 13, 5), 7), ((1, 3, 7, 16, 8), 7), ((2, 1, 3, 4, 2), 3), ((1, 2, 5, 4, 3), 1)],
)


def case(shape, window, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    parts = [torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(3)]
    parts.append(torch.randn(shape[1], 2 * window - 1, 2 * window - 1, generator=generator, dtype=torch.float64))
    return [part.to(dtype).requires_grad_() for part in parts]


@VERSIONS
@SHAPES
def test_attention_agrees_with_plain_loops(version, shape, window):
    parts = case(shape, window)
    want = attention.neighborhood_attention(*(part.detach().numpy() for part in parts), window)
    np.testing.assert_allclose(version(*parts, window).detach().numpy(), want, rtol=1e-12, atol=1e-12)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
def test_no_copy_of_keys_and_values_for_each_neighbor():
    code = "import neighborhood; print(neighborhood.maps_added(128))"
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "benchmarks"), str(ROOT / "src")])}
    ran = subprocess.run([sys.executable, "-c", code], env=paths, capture_output=True, text=True, check=True)
    maps = float(ran.stdout)  # q, k, v, output, their four gradients and a few working rows; with copies 98 more
    assert 4 < maps < 20


@SHAPES
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_numba_attention_and_gradients_equal_reference(shape, window, dtype):
    ours, theirs = case(shape, window, dtype), case(shape, window, dtype)
    actual, want = cpu.neighborhood_attention(*ours, window), reference.neighborhood_attention(*theirs, window)
    close = {"rtol": 1e-10, "atol": 1e-12} if dtype == torch.float64 else {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(actual, want, **close)
    cotangent = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    actual.backward(cotangent)
    want.backward(cotangent)
    for mine, other in zip(ours, theirs):
        torch.testing.assert_close(mine.grad, other.grad, **close)


def test_reference_gradient():
    assert torch.autograd.gradcheck(lambda *p: reference.neighborhood_attention(*p, 3), case((1, 2, 3, 4, 2), 3))


@VERSIONS
def test_attention_without_queries_is_the_mean_of_the_window(version):
    _, k, v, _ = case((1, 2, 9, 8, 3), 7)
    out = version(torch.zeros_like(k), k, v, torch.zeros(2, 13, 13, dtype=torch.float64), 7)
    torch.testing.assert_close(out[0, :, 4, 0], v[0, :, 1:8, 0:7].mean(dim=(1, 2)))
    torch.testing.assert_close(out[0, :, 0, 7], v[0, :, 0:7, 1:8].mean(dim=(1, 2)))


@VERSIONS
def test_bias_belongs_to_the_offset_of_the_neighbor(version):
    zero = torch.zeros(1, 1, 8, 8, 1, dtype=torch.float64)
    value = torch.arange(64, dtype=torch.float64).view(1, 1, 8, 8, 1)
    bias = torch.zeros(1, 13, 13, dtype=torch.float64)
    bias[0, 6, 6] = 100.0  # the pixel itself
    torch.testing.assert_close(version(zero, zero, value, bias, 7), value)
    bias[0, 12, 12] = 300.0  # six rows below, six columns to the right: seen from the corner alone
    out = version(zero, zero, value, bias, 7)
    assert out[0, 0, 0, 0].item() == pytest.approx(6 * 8 + 6)
    assert out[0, 0, 4, 4].item() == pytest.approx(4 * 8 + 4)


def test_window_start_golden_values():
    start = window_start(88, 7)
    assert start[[0, 2, 3, 50, 84, 87]].tolist() == [0, 0, 0, 47, 81, 81]
    assert window_start(100, 7)[[0, 2, 3, 50, 96, 99]].tolist() == [0, 0, 0, 47, 93, 93]


@pytest.mark.parametrize(("length", "window"), [(7, 7), (8, 7), (20, 7), (3, 3), (5, 1)])
def test_queries_of_inverts_the_windows(length, window):
    start, first, last = queries_of(length, window)
    for row in range(length):
        holders = [i for i in range(length) if start[i] <= row < start[i] + window]
        assert holders == list(range(first[row], last[row]))


def test_numba_attention_does_not_depend_on_threads():
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        parts = case((1, 2, 15, 11, 8), 7, torch.float32)
        out = cpu.neighborhood_attention(*parts, 7)
        out.square().sum().backward()
        results.append([out, *(part.grad for part in parts)])
    torch.set_num_threads(before)
    assert all(torch.equal(one, two) for one, two in zip(*results))


def test_bias_may_have_another_type_than_the_rest():
    q, k, v, bias = case((1, 2, 7, 8, 4), 7, torch.float32)
    out = neighborhood_attention(q, k, v, bias.double())
    assert out.dtype == torch.float32
    assert torch.equal(out, neighborhood_attention(q, k, v, bias))


def test_attention_takes_what_is_not_contiguous_and_keeps_nothing_without_gradient():
    qkv = torch.randn(2, 9, 8, 3, 2, 4, generator=torch.Generator().manual_seed(2))
    q, k, v = qkv.permute(3, 0, 4, 1, 2, 5)
    bias = torch.zeros(2, 13, 13, requires_grad=True)
    with torch.no_grad():
        out = neighborhood_attention(q, k, v, bias)
    assert not out.requires_grad
    torch.testing.assert_close(out, reference.neighborhood_attention(q, k, v, bias).detach())


def test_attention_tells_what_is_wrong():
    q, bias = torch.zeros(1, 2, 6, 9, 4), torch.zeros(2, 13, 13)
    with pytest.raises(BeamboxError, match=r"at least 7 x 7 pixels \(the window\), got 6 x 9: pad it with zeros"):
        neighborhood_attention(q, q, q, bias)
    q = torch.zeros(1, 2, 8, 9, 4)
    with pytest.raises(BeamboxError, match=r"`bias` must have shape \(2, 13, 13\), got \(1, 13, 13\)"):
        neighborhood_attention(q, q, q, bias[:1])
    with pytest.raises(BeamboxError, match=r"`k` must have shape \(1, 2, 8, 9, 4\)"):
        neighborhood_attention(q, q[:, :1], q, bias)
    with pytest.raises(BeamboxError, match=r"`window` must be odd and positive, got 4"):
        neighborhood_attention(q, q, q, bias, window=4)
    with pytest.raises(BeamboxError, match=r"`v` must be float32, got float64"):
        neighborhood_attention(q, q, q.double(), bias)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_on_the_cpu_takes_the_fast_version_in_float32(dtype, monkeypatch) -> None:
    import beambox.ops.neighborhood as frontend

    chosen = []
    real = frontend.choose
    monkeypatch.setattr(
        frontend, "choose", lambda name, backends, *given: chosen.append(given) or real(name, backends, *given)
    )
    generator = torch.Generator().manual_seed(3)
    q, k, v = (torch.randn(1, 2, 9, 8, 4, generator=generator).to(dtype).requires_grad_() for _ in range(3))
    bias = torch.randn(2, 13, 13, generator=generator)
    out = frontend.neighborhood_attention(q, k, v, bias, 7)
    assert out.dtype == dtype
    assert [tensor.dtype for tensor in chosen[0]] == [torch.float32] * 4
    expected = frontend.reference.neighborhood_attention(q.double(), k.double(), v.double(), bias.double(), 7)
    assert torch.allclose(out.double(), expected, atol=2e-2)
    out.sum().backward()
    assert all(tensor.grad is not None and tensor.grad.dtype == dtype for tensor in (q, k, v))
