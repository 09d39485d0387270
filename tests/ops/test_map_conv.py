"""Convolutions of maps that skip empty ground: equal to PyTorch's in float64, whatever the map looks like."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from beambox.checks import BeamboxError
from beambox.ops.map_conv import GroundedConv, MapKernel, learning_ground, map_conv
from beambox.ops.map_conv.kernel import Folded

KERNELS: dict[str, Any] = {  # in, out, kernel, stride, padding, dilation, transposed, output padding
    "three": (32, 48, 3, 1, 1, 1, False, 0),
    "three, odd channels": (19, 35, 3, 1, 1, 1, False, 0),
    "wide": (64, 128, 3, 1, 1, 1, False, 0),
    "strided": (32, 64, 3, 2, 1, 1, False, 0),
    "one": (40, 72, 1, 1, 0, 1, False, 0),
    "dilated": (20, 40, 3, 1, 2, 2, False, 0),
    "seven": (16, 16, 7, 1, 3, 1, False, 0),
    "pooling": (16, 16, 2, 2, 0, 1, False, 0),
    "enlarged": (16, 31, 4, 4, 0, 1, True, 0),
    "enlarged by one": (16, 80, 1, 1, 0, 1, True, 0),
    "enlarged, overlapping": (32, 16, 3, 2, 1, 1, True, 1),
    "enlarged, gaps": (16, 16, 1, 2, 0, 1, True, 1),
}
SIZES = [(1, 13, 17), (2, 8, 6), (1, 1, 1), (3, 5, 2), (1, 2, 31)]


def made(name: str, relu: bool = True, seed: int = 0) -> MapKernel:
    c_in, c_out, size, *rest = KERNELS[name]
    transposed = rest[3]
    torch.manual_seed(seed)
    shape = (c_in, c_out) if transposed else (c_out, c_in)
    weight = torch.randn(*shape, size, size) / (c_in * size * size) ** 0.5
    return MapKernel(weight, torch.randn(c_out) * 0.3, *rest, relu=relu)


def exact(bev: Tensor, kernel: MapKernel) -> Tensor:
    """Return PyTorch's answer in float64."""
    assert kernel.bias is not None
    where = {"stride": kernel.stride, "padding": kernel.padding, "dilation": kernel.dilation}
    weight, bias = kernel.weight.double(), kernel.bias.double()
    if kernel.transposed:
        out = functional.conv_transpose2d(bev.double(), weight, bias, output_padding=kernel.output_padding, **where)
    else:
        out = functional.conv2d(bev.double(), weight, bias, **where)
    return out.relu() if kernel.relu else out


def close(ours: Tensor, theirs: Tensor) -> None:
    assert ours.shape == theirs.shape
    torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=1e-5 * max(1.0, float(theirs.abs().max())))


@pytest.fixture(params=["reference", "numba"])
def backend(request, monkeypatch):
    """Run with each backend in turn."""
    monkeypatch.setenv("BEAMBOX_BACKEND", request.param)
    return request.param


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("relu", [True, False])
def test_it_is_the_convolution(name: str, size: tuple[int, ...], relu: bool, backend: str) -> None:
    kernel = made(name, relu)
    bev = torch.randn(size[0], kernel.in_channels, *size[1:])
    if name == "pooling" and min(size[1:]) < 2:
        with pytest.raises(BeamboxError, match="smaller than the kernel"):
            map_conv(bev, kernel)
        return
    close(map_conv(bev, kernel), exact(bev, kernel))
    close(map_conv(bev.contiguous(memory_format=torch.channels_last), kernel), exact(bev, kernel))


@pytest.mark.parametrize("name", [name for name, options in KERNELS.items() if options[6]])
def test_it_writes_to_its_channels_of_a_buffer_and_leaves_out_what_has_no_room(name: str, backend: str) -> None:
    kernel = made(name)
    bev = torch.randn(2, kernel.in_channels, 5, 4)
    whole = exact(bev, kernel)
    cut = kernel.stride > 1
    buffer = torch.full((2, whole.shape[2] - cut, whole.shape[3] - cut, kernel.out_channels + 7), 5.0)
    room = buffer.permute(0, 3, 1, 2)[:, 3:-4]
    assert map_conv(bev, kernel, out=room) is room
    close(room, whole[:, :, : room.shape[2], : room.shape[3]])
    assert (buffer[..., :3] == 5).all() and (buffer[..., -4:] == 5).all()


def chain(names: tuple[str, ...]) -> list[GroundedConv]:
    return [GroundedConv(made(name, seed=k)) for k, name in enumerate(names)]


NETWORK = ("strided", "wide", "enlarged here", "one here")
KERNELS["enlarged here"] = (128, 40, 2, 2, 0, 1, True, 0)
KERNELS["one here"] = (40, 72, 1, 1, 0, 1, False, 0)


def through(layers: list[GroundedConv], bev: Tensor) -> Tensor:
    for layer in layers:
        bev = layer(bev)
    return bev


@settings(max_examples=40, deadline=None)
@given(
    batch=st.integers(1, 3),
    height=st.integers(1, 21),
    width=st.integers(1, 19),
    share=st.sampled_from([0.0, 0.01, 0.1, 1.0]),
    corners=st.booleans(),
    seed=st.integers(0, 99),
)
def test_what_empty_ground_gives_need_not_be_computed(
    batch: int, height: int, width: int, share: float, corners: bool, seed: int
) -> None:
    """Any occupancy: none, corners and borders, everything; the same bits as without what was remembered."""
    layers, fresh = chain(NETWORK), chain(NETWORK)
    random = torch.Generator().manual_seed(seed)
    bev = torch.randn(batch, 32, height, width, generator=random)
    keep = torch.rand(batch, 1, height, width, generator=random) < share
    if corners:
        keep[-1, :, :: max(1, height - 1), :: max(1, width - 1)] = True
    bev = (bev * keep).contiguous(memory_format=torch.channels_last)
    with learning_ground():
        through(layers, torch.zeros(1, 32, height, width))
    assert torch.equal(through(layers, bev), through(fresh, bev))
    theirs = bev
    for layer in layers:
        theirs = exact(theirs, layer.kernel)
    close(through(layers, bev), theirs)


def test_cells_of_empty_ground_are_left_out() -> None:
    """The test above would hold if everything were computed: here a wrong memory shows where it is used."""
    layer = GroundedConv(made("three"))
    with learning_ground():
        layer(torch.zeros(1, 32, 40, 40))
    (ground,) = layer._grounds.values()
    ground.answer.table.fill_(77.0)
    bev = torch.zeros(1, 32, 40, 40)
    bev[0, 3, 20, 10] = 1.0
    seen = (layer(bev)[0] != 77.0).any(dim=0)  # (40, 40)
    assert seen[20, 10] and 9 <= seen.sum() <= 36, "a cell reaches 3 x 3 cells, computed 2 x 2 at a time"


def test_a_changed_weight_is_noticed() -> None:
    layer = GroundedConv(made("three"))
    bev = torch.zeros(1, 32, 9, 9)
    bev[0, :, 4, 4] = 1.0
    with learning_ground():
        layer(torch.zeros(1, 32, 9, 9))
    layer(bev)
    for tensor in layer.kernel.tensors():
        with torch.no_grad():
            tensor.mul_(-2.0)
        close(layer(bev), exact(bev, layer.kernel))


def test_a_nan_is_seen_where_it_reaches() -> None:
    layer = GroundedConv(made("strided"))
    with learning_ground():
        layer(torch.zeros(1, 32, 12, 12))
    bev = torch.zeros(1, 32, 12, 12)
    bev[0, 31, 6, 7] = torch.nan
    assert torch.equal(layer(bev).isnan(), exact(bev, layer.kernel).isnan())
    assert layer(bev).isnan().any()


@pytest.mark.parametrize("name", ["three", "strided", "enlarged, overlapping"])
def test_the_same_bits_on_any_number_of_threads(name: str) -> None:
    kernel = made(name)
    bev = torch.randn(2, kernel.in_channels, 41, 37)
    before, answers = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            layer = GroundedConv(kernel)
            with learning_ground():
                layer(bev[:1])
            answers.append(layer(bev))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(answers[0], answers[1]) and torch.equal(answers[0], answers[2])


def test_training_and_half_precision_are_left_to_pytorch(monkeypatch) -> None:
    monkeypatch.setenv("BEAMBOX_BACKEND", "numba")
    kernel = made("three")
    bev = torch.randn(1, 32, 6, 6, requires_grad=True)
    map_conv(bev, kernel).sum().backward()
    assert bev.grad is not None and bev.grad.abs().sum() > 0
    with torch.autocast("cpu", dtype=torch.bfloat16), torch.no_grad():
        assert map_conv(bev, kernel).dtype == torch.bfloat16


def test_a_map_far_from_its_borders_is_remembered_once() -> None:
    bev = torch.zeros(1, 5, 30, 40)
    bev[:, :, 0], bev[:, :, :, -1] = 1.0, 2.0
    folded = Folded.of(bev)
    assert folded.table.shape == (2, 2, 5)
    assert torch.equal(folded.unfolded(), bev)


def test_what_does_not_fit_is_refused() -> None:
    kernel = made("enlarged")
    with pytest.raises(BeamboxError, match="bev"):
        map_conv(torch.zeros(1, 15, 4, 4), kernel)
    bev = torch.zeros(1, 16, 4, 4)
    with pytest.raises(BeamboxError, match="fewer than a stride"):
        map_conv(bev, kernel, out=torch.zeros(1, 31, 12, 12).contiguous(memory_format=torch.channels_last))
    with pytest.raises(BeamboxError, match="channels last"):
        map_conv(bev, kernel, out=torch.zeros(1, 31, 16, 16))
