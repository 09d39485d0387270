"""The Triton kernels of neighbourhood attention, on a GPU or through Triton's interpreter (see test_triton.py)."""

import pytest
import torch

from beambox.ops.neighborhood import neighborhood_attention, reference

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.mark.parametrize(
    ("shape", "window", "dtype"),
    [
        ((1, 1, 7, 9, 5), 7, torch.float64),
        ((2, 1, 3, 34, 3), 3, torch.float64),  # two stretches a row
        ((1, 2, 5, 4, 4), 3, torch.float32),
        ((1, 1, 1, 2, 1), 1, torch.float32),
    ],
)
def test_attention_and_gradients_equal_reference(shape, window, dtype):
    generator = torch.Generator().manual_seed(0)
    parts = [torch.randn(shape, generator=generator) for _ in range(4)]
    parts.append(torch.randn(shape[1], 2 * window - 1, 2 * window - 1, generator=generator))
    parts = [part.to(DEVICE, dtype) for part in parts]
    cotangent = parts.pop(3)
    ours, theirs = ([part.clone().requires_grad_() for part in parts] for _ in range(2))
    actual, want = neighborhood_attention(*ours, window), reference.neighborhood_attention(*theirs, window)
    close = {"rtol": 1e-10, "atol": 1e-12} if dtype == torch.float64 else {"rtol": 1e-4, "atol": 1e-5}
    torch.testing.assert_close(actual, want, **close)
    actual.backward(cotangent)
    want.backward(cotangent)
    for mine, other in zip(ours, theirs):
        torch.testing.assert_close(mine.grad, other.grad, **close)


def test_half_precision_stays_half_and_close():
    q, k, v = torch.randn(3, 1, 1, 4, 5, 4, generator=torch.Generator().manual_seed(1)).to(DEVICE)
    bias = torch.zeros(1, 5, 5, device=DEVICE)
    actual = neighborhood_attention(*(part.bfloat16() for part in (q, k, v, bias)), window=3)
    assert actual.dtype == torch.bfloat16
    torch.testing.assert_close(actual.float(), reference.neighborhood_attention(q, k, v, bias, 3), rtol=5e-2, atol=5e-2)
