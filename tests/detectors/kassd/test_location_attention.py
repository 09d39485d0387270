import math

import pytest
import torch

from beambox.detectors.kassd.necks import DenseASPP, PyramidAttention, SpatialPyramidPooling
from beambox.detectors.kassd.network import FeatureReuse, LamReduce, LocationAttention, location_attention


def test_attention_equals_a_literal_softmax() -> None:
    generator = torch.Generator().manual_seed(0)
    high, low = torch.randn(2, 2, 5, 4, 3, generator=generator, dtype=torch.float64)
    ours = location_attention(high, low)
    for b in range(2):
        for y in range(4):
            for x in range(3):
                sums = [sum(level[b, c, y, x].item() for c in range(5)) for level in (high, low)]
                weights = [math.exp(s) / sum(math.exp(t) for t in sums) for s in sums]
                wanted = weights[0] * high[b, :, y, x] + weights[1] * low[b, :, y, x]
                torch.testing.assert_close(ours[b, :, y, x], wanted)


def test_weights_of_sums_two_and_one() -> None:
    high, low = torch.tensor([2.0, 0]).reshape(1, 2, 1, 1), torch.tensor([0, 1.0]).reshape(1, 2, 1, 1)
    both = location_attention(high, low).flatten()
    assert both.tolist() == pytest.approx([2 * 0.7310586, 1 - 0.7310586], abs=1e-6)
    softer = location_attention(high, low, LamReduce.MEAN).flatten()
    assert softer[0].item() == pytest.approx(2 / (1 + math.exp(-0.5)))


def test_large_sums_do_not_overflow_and_gradients_are_right() -> None:
    high, low = torch.full((1, 128, 2, 2), 50.0), torch.full((1, 128, 2, 2), 49.0)
    torch.testing.assert_close(location_attention(high, low), high)
    torch.testing.assert_close(location_attention(low, high), high)
    pair = torch.randn(2, 1, 3, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: location_attention(p[0], p[1]), (pair,))


def test_half_precision_sums_in_single() -> None:
    generator = torch.Generator().manual_seed(0)
    high = torch.rand(1, 128, 2, 2, generator=generator).bfloat16()
    low = high.clone()
    low[:, 0] += 0.25
    both = location_attention(high, low)
    assert both.dtype is torch.bfloat16
    torch.testing.assert_close(both.float(), location_attention(high.float(), low.float()), atol=0.01, rtol=0.01)


def test_attention_has_no_parameters_and_off_adds() -> None:
    torch.manual_seed(0)
    on, off = LocationAttention(6, 4).eval(), LocationAttention(6, 4, lam=False).eval()
    off.load_state_dict(on.state_dict())
    bev = torch.rand(1, 6, 8, 6)
    high, low = on.levels(bev)
    torch.testing.assert_close(off(bev), high + low)
    torch.testing.assert_close(on(bev), location_attention(high, low))
    assert not torch.allclose(on(bev), off(bev))


def test_reuse_adds_the_first_features_to_the_later_ones() -> None:
    torch.manual_seed(0)
    on, off = FeatureReuse(6, 4).eval(), FeatureReuse(6, 4, reuse=False).eval()
    off.load_state_dict(on.state_dict())
    bev = torch.rand(1, 6, 8, 6)
    f0 = on.reduce(bev)
    plain, summed = on.three(f0), on.three(f0) + f0
    high, low = on(bev)
    torch.testing.assert_close(high, on.up_high(on.down(summed)) + summed + f0)
    torch.testing.assert_close(low, on.up_low(on.down(summed)) + f0)
    high, low = off(bev)
    torch.testing.assert_close(high, on.up_high(on.down(plain)) + plain)
    torch.testing.assert_close(low, on.up_low(on.down(plain)))


def test_parameters_of_the_published_size() -> None:
    with torch.device("meta"):
        assert sum(p.numel() for p in LocationAttention(256).parameters()) == 2_542_592


@pytest.mark.parametrize("size", [(8, 8), (7, 9), (1, 1), (5, 2)])
def test_sizes_are_kept_odd_ones_too(size: tuple[int, int]) -> None:
    bev = torch.rand(2, 6, *size)
    for module in (LocationAttention(6, 8), PyramidAttention(6, 8, (1, 1, 1))):
        assert module.eval()(bev).shape == (2, 8, *size)
    for module in (DenseASPP(8), SpatialPyramidPooling(8)):
        assert module.eval()(torch.rand(2, 8, *size)).shape == (2, 8, *size)


def test_pooling_sees_the_largest_window_and_no_further() -> None:
    torch.manual_seed(0)
    module = SpatialPyramidPooling(2).eval()
    bev = torch.zeros(1, 2, 31, 31)
    peak = bev.clone()
    peak[..., 15, 15] = 5.0
    changed = (module(peak) - module(bev)).abs().sum(dim=1)[0] > 0
    rows = torch.nonzero(changed)
    assert (int(rows.min()), int(rows.max())) == (15 - 6, 15 + 6)


def test_dense_dilated_convolutions_reach_their_sum() -> None:
    torch.manual_seed(0)
    module = DenseASPP(8)
    for layer in module.modules():
        if isinstance(layer, torch.nn.Conv2d):
            torch.nn.init.constant_(layer.weight, 0.1)  # so that no ReLU hides the reach
    bev = torch.zeros(1, 8, 95, 95)
    bev[..., 47, 47] = 1.0
    seen = torch.nonzero(module.eval()(bev).sum(dim=1)[0])
    assert int(seen.max()) - 47 == 3 + 6 + 12 + 18


def test_every_level_of_the_pyramid_sees_the_others() -> None:
    torch.manual_seed(0)
    module = PyramidAttention(4, 4, (1, 1, 1))
    module(torch.rand(2, 4, 8, 8)).sum().backward()
    silent = [n for n, p in module.named_parameters() if p.grad is None]
    assert silent == []
    assert set(module.from_coarser) == {"1to0", "2to0", "2to1"}
