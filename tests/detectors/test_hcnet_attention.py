import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from beambox.checks import BeamboxError
from beambox.detectors.hcnet import (
    CBAM,
    AdaptiveAdjustment,
    Gate,
    HeightChannelFusion,
    HeightChannelKind,
    one_stack_a_voxel,
    pillar_stacks,
    pseudo_images,
)
from beambox.geometry.grid import VoxelGrid
from beambox.ops.scatter import scatter_bev
from beambox.ops.voxelize import Voxels, voxelize
from oracles import attention as oracle

KINDS = list(HeightChannelKind)


def grid_of(slices: int, nx: int = 4, ny: int = 3) -> VoxelGrid:
    return VoxelGrid((0.0, 0.0, 0.0), (float(nx), float(ny), float(slices)), (1.0, 1.0, 1.0))


def some_voxels(count: int, slices: int, batch: int, seed: int) -> Voxels:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 4, generator=generator) * torch.tensor([4.0, 3.0, float(slices), 1.0])
    sample = torch.randint(0, batch, (count,), generator=generator).sort().values
    return voxelize(points, sample, batch, grid_of(slices))


def features_of(voxels: Voxels, channels: int, seed: int, dtype: torch.dtype) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.relu(torch.randn(len(voxels), channels, generator=generator, dtype=torch.float64)).to(dtype)


def fusion(channels: int, slices: int, kind: HeightChannelKind, seed: int, dtype: torch.dtype) -> HeightChannelFusion:
    torch.manual_seed(seed)
    module = HeightChannelFusion(channels, slices, kind, height_hidden=3, channel_hidden=2).to(dtype)
    for parameter in module.parameters():  # large enough that the weights leave 0.5
        nn.init.normal_(parameter)
    return module


def parameters_of(branch: nn.Module | None) -> tuple[np.ndarray, ...] | None:
    return None if branch is None else tuple(p.detach().numpy() for p in branch.parameters())


@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(0, 40),
    slices=st.integers(1, 5),
    batch=st.integers(1, 3),
    channels=st.integers(1, 6),
    kind=st.sampled_from(KINDS),
    seed=st.integers(0, 1000),
)
def test_occupied_pillars_agree_with_every_pixel(
    count: int, slices: int, batch: int, channels: int, kind: HeightChannelKind, seed: int
) -> None:
    voxels = some_voxels(count, slices, batch, seed)
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-12)):
        module = fusion(channels, slices, kind, seed, dtype)
        results, gradients = [], []
        for dense in (False, True):
            features = features_of(voxels, channels, seed, dtype).requires_grad_()
            module.zero_grad()
            if dense:
                image = module.dense(pseudo_images(features, voxels))
            else:
                stacks, index = pillar_stacks(features, voxels)
                image = scatter_bev(module(stacks), index, batch, (3, 4))
            pull = torch.linspace(-1, 1, image.numel(), dtype=dtype).reshape(image.shape)
            (image * pull).sum().backward()
            results.append(image.detach())
            occupied = features.detach() > 0  # at 0 the features' own ReLU stops the gradient
            grads = [features.grad * occupied, *(p.grad for p in module.parameters())]
            gradients.append(grads)
        scale = max(1.0, float(results[1].abs().max()))
        torch.testing.assert_close(results[0], results[1], atol=tolerance * scale, rtol=0)
        for sparse, dense in zip(*gradients):
            torch.testing.assert_close(sparse, dense, atol=20 * tolerance, rtol=20 * tolerance)


@pytest.mark.parametrize("kind", KINDS)
def test_every_pixel_follows_the_equations(kind: HeightChannelKind) -> None:
    module = fusion(3, 4, kind, 1, torch.float64)
    images = torch.rand(2, 3, 2, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    images = images * (images > 0.4)
    expected = oracle.height_channel(images.numpy(), parameters_of(module.height), parameters_of(module.channel))
    np.testing.assert_allclose(module.dense(images).detach().numpy(), expected, atol=1e-12)


def test_pseudo_images_have_the_papers_shape_and_hold_each_voxel_once() -> None:
    voxels = some_voxels(25, 4, 2, 0)
    features = features_of(voxels, 5, 0, torch.float32) + 1
    images = pseudo_images(features, voxels)
    assert images.shape == (2, 5, 3, 4, 4)
    for row, (b, z, y, x) in zip(features, voxels.index.tolist()):
        torch.testing.assert_close(images[b, :, y, x, z], row)
    assert int((images != 0).sum()) == features.numel()


def test_stacks_hold_each_voxel_at_its_height() -> None:
    voxels = some_voxels(25, 4, 2, 3)
    features = features_of(voxels, 5, 0, torch.float32) + 1
    stacks, index = pillar_stacks(features, voxels)
    place = {(b, y, x): m for m, (b, _, y, x) in enumerate(index.tolist())}
    assert len(place) == len(stacks) == len({(b, y, x) for b, _, y, x in voxels.index.tolist()})
    for row, (b, z, y, x) in zip(features, voxels.index.tolist()):
        torch.testing.assert_close(stacks[place[b, y, x], z], row)
    assert int((stacks != 0).sum()) == features.numel()


@pytest.mark.parametrize("count", [0, 1, 25])
def test_one_stack_a_voxel_makes_the_same_image(count: int) -> None:
    voxels = some_voxels(count, 4, 2, 3)
    features = features_of(voxels, 5, 0, torch.float32)
    module = fusion(5, 4, HeightChannelKind.BOTH, 0, torch.float32)
    images = []
    for stacked in (pillar_stacks, one_stack_a_voxel):
        stacks, index = stacked(features, voxels)
        images.append(scatter_bev(module(stacks), index, 2, (3, 4)))
    assert len(stacks) == len(voxels)
    torch.testing.assert_close(images[1], images[0], atol=1e-6, rtol=0)


def test_a_slice_that_is_not_there_is_refused() -> None:
    module = HeightChannelFusion(8, 4, HeightChannelKind.BOTH)
    with pytest.raises(BeamboxError, match=r"`stacks` must have shape \(any, 4, any\), got \(2, 3, 8\)"):
        module(torch.zeros(2, 3, 8))
    with pytest.raises(BeamboxError, match=r"`images` must have shape \(any, any, any, any, 4\)"):
        module.dense(torch.zeros(1, 8, 2, 2, 3))


def test_weight_is_one_half_where_either_attention_is_zero() -> None:
    images = torch.rand(1, 6, 2, 2, 4)
    for silenced in ("height", "channel"):
        module = fusion(6, 4, HeightChannelKind.BOTH, 2, torch.float32)
        branch = module.height if silenced == "height" else module.channel
        assert branch is not None
        nn.init.zeros_(branch[2].weight)
        nn.init.constant_(branch[2].bias, -1.0)  # ReLU makes it 0
        weight = module.attention(images)
        assert weight.shape == (1, 6, 2, 2, 4)
        assert bool((weight == 0.5).all())
        torch.testing.assert_close(module.dense(images), 0.5 * images.amax(dim=4))


def test_weights_lie_from_one_half_to_one() -> None:
    weight = fusion(6, 4, HeightChannelKind.BOTH, 4, torch.float32).attention(torch.rand(2, 6, 5, 5, 4)).detach()
    assert float(weight.min()) >= 0.5 and float(weight.max()) <= 1.0
    assert float(weight.max()) > 0.6


def test_a_kind_has_only_the_parameters_it_uses() -> None:
    counts = {kind: sum(p.numel() for p in HeightChannelFusion(64, 4, kind).parameters()) for kind in KINDS}
    height, channel = 4 * 4 + 4 + 4 * 4 + 4, 64 * 16 + 16 + 16 * 64 + 64
    assert counts == {
        HeightChannelKind.NONE: 0,
        HeightChannelKind.CHANNEL: channel,
        HeightChannelKind.HEIGHT: height,
        HeightChannelKind.BOTH: height + channel,
    }


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_the_height_channel_block(kind: HeightChannelKind) -> None:
    module = fusion(3, 4, kind, 5, torch.float64)
    stacks = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1
    images = stacks.permute(2, 0, 1).reshape(1, 3, 1, 3, 4).clone()
    names = [name for name, _ in module.named_parameters()]
    values = [p.detach().clone().requires_grad_() for p in module.parameters()]

    def sparse(x: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(module, dict(zip(names, parameters)), (x,))

    assert torch.autograd.gradcheck(sparse, (stacks.requires_grad_(), *values))
    assert torch.autograd.gradcheck(module.dense, (images.requires_grad_(),))


@pytest.mark.parametrize("gate", list(Gate))
@pytest.mark.parametrize("training", [True, False])
def test_gradients_of_the_adaptive_adjustment(gate: Gate, training: bool) -> None:
    torch.manual_seed(0)
    module = AdaptiveAdjustment(2, gate).double().train(training)
    bev = torch.randn(2, 2, 4, 5, dtype=torch.float64, requires_grad=True)
    names = [name for name, _ in module.named_parameters()]
    values = [torch.randn_like(p, requires_grad=True) for p in module.parameters()]

    def run(x: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(module, dict(zip(names, parameters)), (x,))

    assert torch.autograd.gradcheck(run, (bev, *values))


@pytest.mark.parametrize("gate", list(Gate))
def test_adaptive_adjustment_follows_equations_4_to_6(gate: Gate) -> None:
    torch.manual_seed(0)
    module = AdaptiveAdjustment(2, gate).double().eval()
    norms = [module.rows[1], module.columns[1]]
    for norm in norms:
        norm.eps = 0.0
        nn.init.normal_(norm.bias)
    bev = torch.randn(1, 2, 4, 5, dtype=torch.float64)
    rows, columns = oracle.strip_weights(
        bev[0].numpy(),
        module.rows[0].weight[..., 0].detach().numpy(),
        module.columns[0].weight[:, :, 0].detach().numpy(),
    )
    rows, columns = (part + norm.bias.detach().numpy()[:, None] for part, norm in zip((rows, columns), norms))
    weighed = module(bev)[0].detach()
    for c in range(2):
        for i in range(4):
            for j in range(5):
                relu = max(rows[c, i], 0) + max(columns[c, j], 0)
                weight = relu if gate is Gate.RELU else oracle.sigmoid(rows[c, i] + columns[c, j])
                assert float(weighed[c, i, j]) == pytest.approx(weight * float(bev[0, c, i, j]), abs=1e-12)


def test_an_even_strip_kernel_is_refused() -> None:
    with pytest.raises(BeamboxError, match="`kernel` must be odd"):
        AdaptiveAdjustment(4, kernel=2)


def test_cbam_weighs_channels_then_places() -> None:
    torch.manual_seed(0)
    module = CBAM(6, reduction=3).eval()
    bev = torch.randn(2, 6, 8, 9)
    first, second = module.channel[0].weight, module.channel[2].weight
    for b in range(2):
        pooled = [bev[b].flatten(1).mean(1), bev[b].flatten(1).max(1).values]
        channel = torch.sigmoid(sum(second @ torch.relu(first @ p) for p in pooled))
        weighed = bev[b] * channel[:, None, None]
        maps = torch.stack((weighed.mean(0), weighed.max(0).values))[None]
        place = torch.sigmoid(torch.conv2d(maps, module.place[0].weight, padding=3) / (1 + 1e-3) ** 0.5)
        torch.testing.assert_close(module(bev)[b], (weighed * place[0]), atol=1e-6, rtol=1e-5)


def test_cbam_keeps_some_hidden_channels_in_narrow_maps() -> None:
    assert CBAM(4, reduction=16).channel[0].weight.shape == (4, 4)
    assert CBAM(448, reduction=16).channel[0].weight.shape == (28, 448)
