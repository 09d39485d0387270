"""The transformer block with neighbourhood attention."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn import functional

from beambox.checks import BeamboxError
from beambox.detectors.dennet import NeighborhoodAttention, NeighborhoodBlock


def size_of(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def by_loops(module: NeighborhoodAttention, pixels: torch.Tensor) -> torch.Tensor:
    """Attention of one sample ``(H, W, C)``, pixel by pixel and head by head."""
    height, width, channels = pixels.shape
    depth, window, reach = channels // module.heads, module.window, module.window // 2
    qkv = module.qkv(pixels).view(height, width, 3, module.heads, depth)
    out = torch.zeros(height, width, module.heads, depth, dtype=pixels.dtype)
    for i in range(height):
        for j in range(width):
            top, left = min(max(i - reach, 0), height - window), min(max(j - reach, 0), width - window)
            for head in range(module.heads):
                logits, values = [], []
                for r in range(top, top + window):
                    for c in range(left, left + window):
                        bias = module.bias[head, r - i + window - 1, c - j + window - 1]
                        logits.append(qkv[i, j, 0, head] @ qkv[r, c, 1, head] / math.sqrt(depth) + bias)
                        values.append(qkv[r, c, 2, head])
                out[i, j, head] = torch.stack(logits).softmax(dim=0) @ torch.stack(values)
    return module.out(out.flatten(2))


@torch.no_grad()
def test_attention_agrees_with_loops_over_pixels() -> None:
    torch.manual_seed(0)
    module = NeighborhoodAttention(6, heads=2, window=5).double()
    pixels = torch.randn(2, 6, 8, 6, dtype=torch.float64)
    expected = torch.stack([by_loops(module, sample) for sample in pixels])
    torch.testing.assert_close(module(pixels), expected, atol=1e-10, rtol=1e-8)


@torch.no_grad()
def test_without_queries_and_bias_it_is_the_mean_of_the_shifted_window() -> None:
    torch.manual_seed(0)
    module = NeighborhoodAttention(4, heads=2)
    module.qkv.weight[:4] = 0
    module.qkv.weight[8:] = torch.eye(4)
    module.qkv.bias.zero_()
    module.bias.zero_()
    module.out.weight.copy_(torch.eye(4))
    module.out.bias.zero_()
    pixels = torch.randn(1, 9, 12, 4)
    means = functional.avg_pool2d(pixels.permute(0, 3, 1, 2), 7, stride=1)  # (1, 4, 3, 6), whole windows only
    rows = torch.tensor([0, 0, 0, 0, 1, 2, 2, 2, 2])
    columns = torch.tensor([0, 0, 0, 0, 1, 2, 3, 4, 5, 5, 5, 5])
    expected = means[:, :, rows][:, :, :, columns].permute(0, 2, 3, 1)
    torch.testing.assert_close(module(pixels), expected, atol=1e-6, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize(("height", "width"), [(3, 5), (9, 2), (1, 1)])
def test_a_map_smaller_than_the_window_is_padded_and_cut(height: int, width: int) -> None:
    torch.manual_seed(0)
    module = NeighborhoodAttention(4, heads=1)
    pixels = torch.randn(2, height, width, 4)
    padded = torch.zeros(2, max(height, 7), max(width, 7), 4)
    padded[:, :height, :width] = pixels
    torch.testing.assert_close(module(pixels), module(padded)[:, :height, :width])


@torch.no_grad()
@pytest.mark.parametrize("mlp", [True, False])
def test_the_block_adds_attention_and_perceptron_to_its_input(mlp: bool) -> None:
    torch.manual_seed(0)
    block = NeighborhoodBlock(8, heads=2, window=3, mlp=mlp)
    bev = torch.randn(2, 8, 5, 6)
    pixels = bev.permute(0, 2, 3, 1)
    expected = pixels + block.attention(functional.layer_norm(pixels, (8,)))
    if block.mlp is not None:
        _, wide, _, narrow = block.mlp
        expected = expected + narrow(functional.gelu(wide(functional.layer_norm(expected, (8,)))))
    torch.testing.assert_close(block(bev), expected.permute(0, 3, 1, 2), atol=1e-6, rtol=1e-5)


def test_parameters_of_the_published_blocks() -> None:
    assert size_of(NeighborhoodBlock(64, 2)) + size_of(NeighborhoodBlock(128, 4)) == 208118
    assert size_of(NeighborhoodBlock(64, 2, mlp=False)) == 4 * 64 * 64 + 4 * 64 + 2 * 64 + 2 * 13 * 13


def test_gradients() -> None:
    torch.manual_seed(0)
    block = NeighborhoodBlock(2, heads=1, window=3, ratio=1).double()
    names, values = zip(*((name, p.detach().requires_grad_()) for name, p in block.named_parameters()))
    bev = torch.randn(1, 2, 3, 4, dtype=torch.float64, requires_grad=True)

    def run(x: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(block, dict(zip(names, parameters)), (x,))

    assert torch.autograd.gradcheck(run, (bev, *values))


def test_under_autocast_it_still_runs() -> None:
    block = NeighborhoodBlock(8, heads=2, window=3)
    with torch.autocast("cpu", torch.bfloat16):
        out = block(torch.randn(1, 8, 5, 6))
    out.float().sum().backward()
    assert block.attention.bias.grad is not None


def test_heads_must_divide_the_channels() -> None:
    with pytest.raises(BeamboxError, match="`heads` must divide the 64 channels, got 3"):
        NeighborhoodBlock(64, heads=3)
