import math

import torch

from beambox.layers.losses import sigmoid_focal, sine_difference, smooth_l1


def test_focal_of_plain_numbers() -> None:
    logits = torch.tensor([0.0, 2.0, -3.0], dtype=torch.float64)
    targets = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)

    def by_hand(x: float, t: float) -> float:
        p = 1 / (1 + math.exp(-x))
        return -0.25 * (1 - p) ** 2 * math.log(p) if t else -0.75 * p**2 * math.log(1 - p)

    wanted = torch.tensor([by_hand(x, t) for x, t in zip(logits.tolist(), targets.tolist())], dtype=torch.float64)
    torch.testing.assert_close(sigmoid_focal(logits, targets), wanted)


def test_focal_gradient() -> None:
    logits = torch.randn(7, dtype=torch.float64, requires_grad=True)
    targets = torch.tensor([0.0, 1, 0, 1, 0.3, 0, 1], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: sigmoid_focal(x, targets), logits)


def test_smooth_l1_is_continuous_and_linear_beyond_beta() -> None:
    beta = 1 / 9
    at = smooth_l1(torch.tensor([beta - 1e-9, beta + 1e-9], dtype=torch.float64), beta)
    assert abs(float(at[0] - at[1])) < 1e-8
    assert float(smooth_l1(torch.tensor(2.0), 1.0)) == 1.5


def test_sine_difference_ignores_half_turns() -> None:
    predicted = torch.tensor([[0.0, 0, 0, 0, 0, 0, 0.3]])
    target = predicted.clone()
    target[0, 6] += math.pi
    assert float(sine_difference(predicted, target).abs().max()) < 1e-6
