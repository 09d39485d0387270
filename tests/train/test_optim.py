"""The optimiser, its schedule and the moving average."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from beambox.train.config import OptimSection
from beambox.train.optim import Ema, adam, apply_schedule, one_cycle, schedule

OPTIM = OptimSection(lr=0.003, iterations=1000)


@pytest.mark.parametrize(
    ("step", "lr", "beta1"),
    [
        (0, 3.0e-4, 0.95),
        (200, 1.65e-3, 0.90),
        (400, 3.0e-3, 0.85),
        (700, 1.500015e-3, 0.90),
        (999, 5.056e-8, 0.9499993),
    ],
)
def test_one_cycle_golden_values(step: int, lr: float, beta1: float) -> None:
    assert one_cycle(step, 1000, 0.003) == (pytest.approx(lr, rel=1e-4), pytest.approx(beta1, abs=1e-7))


@pytest.mark.parametrize("name", ["one-cycle", "cosine", "constant"])
@pytest.mark.parametrize("total", [1, 2, 7])
def test_schedules_stay_positive_and_bounded_in_short_runs(name: str, total: int) -> None:
    optim = OptimSection(lr=0.01, iterations=total, schedule=name)  # pyright: ignore
    for step in range(total):
        lr, beta1 = schedule(optim, step, total)
        assert 0 < lr <= 0.01
        assert 0.85 <= beta1 <= 0.95


def test_weight_decay_is_decoupled_and_reaches_batch_norm() -> None:
    layer = nn.BatchNorm1d(3)
    optimizer = adam(layer.parameters(), OptimSection(lr=0.1, weight_decay=0.5, iterations=1))
    lr = apply_schedule(optimizer, OPTIM, 0, 1000)
    for parameter in layer.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    torch.testing.assert_close(layer.weight, torch.full((3,), 1 - lr * 0.5))


def test_first_step_moves_by_the_learning_rate() -> None:
    parameter = nn.Parameter(torch.tensor([1.0, 1.0]))
    optimizer = adam([parameter], OptimSection(lr=0.003, weight_decay=0.0, iterations=1000))
    lr = apply_schedule(optimizer, OPTIM, 200, 1000)
    parameter.grad = torch.tensor([5.0, -0.1])
    optimizer.step()  # Adam's first step is lr * sign(gradient), whatever beta1
    torch.testing.assert_close(parameter.data, torch.tensor([1.0 - lr, 1.0 + lr]))


def test_ema_follows_the_formula_with_warm_up() -> None:
    module = nn.BatchNorm1d(1)
    ema = Ema(module, decay=0.5)
    expected = 1.0
    for update in range(1, 15):
        with torch.no_grad():
            module.weight.fill_(float(update))
            module.running_mean.fill_(float(update))
            module.num_batches_tracked.fill_(update)
        ema.update()
        keep = min(0.5, (1 + update) / (10 + update))
        expected = keep * (expected if update > 1 else 1.0) + (1 - keep) * update
    assert ema.module.weight.item() == pytest.approx(expected, rel=1e-6)
    assert ema.module.num_batches_tracked.item() == 14
    assert not ema.module.weight.requires_grad
    assert not ema.module.training
    assert module.training
