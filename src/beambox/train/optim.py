"""Adam with decoupled weight decay, the one-cycle schedule, and the moving average of weights."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from beambox.train.config import OptimSection

__all__ = ["Ema", "adam", "apply_schedule", "one_cycle", "schedule"]

BETA1_HIGH, BETA1_LOW, BETA2, EPS = 0.95, 0.85, 0.99, 1e-8


def adam(parameters: Iterable[nn.Parameter], optim: OptimSection) -> torch.optim.AdamW:
    """Adam whose weight decay is p <- p (1 - lr wd) on every parameter, batch-norm's included."""
    return torch.optim.AdamW(
        [p for p in parameters if p.requires_grad],
        lr=optim.lr,
        betas=(BETA1_HIGH, BETA2),
        eps=EPS,
        weight_decay=optim.weight_decay,
        foreach=True,
    )


def _cosine(start: float, end: float, share: float) -> float:
    return end + (start - end) / 2 * (math.cos(math.pi * share) + 1)


def one_cycle(step: int, total: int, lr: float, warmup: float = 0.4) -> tuple[float, float]:
    """Learning rate and beta1 of a step, counted from 0.

    The rate rises from ``lr`` / 10 to ``lr`` over the first floor(``warmup`` ``total``) steps along a cosine and falls
    to ``lr`` / 10 / 10^4 over the rest; beta1 goes from 0.95 to 0.85 and back along the same shape.
    """
    rise = int(warmup * total)
    if step < rise:
        share = step / rise
        return _cosine(lr / 10, lr, share), _cosine(BETA1_HIGH, BETA1_LOW, share)
    share = (step - rise) / max(1, total - rise)
    return _cosine(lr, lr / 1e5, share), _cosine(BETA1_LOW, BETA1_HIGH, share)


def schedule(optim: OptimSection, step: int, total: int) -> tuple[float, float]:
    """Learning rate and beta1 of a step, counted from 0, under the recipe's schedule."""
    if optim.schedule == "one-cycle":
        return one_cycle(step, total, optim.lr, optim.warmup)
    if optim.schedule == "constant":
        return optim.lr, 0.9
    rise = int(optim.warmup * total)
    if step < rise:
        return optim.lr * (step + 1) / (rise + 1), 0.9
    return _cosine(optim.lr, 0.0, (step - rise) / max(1, total - rise)), 0.9


def apply_schedule(optimizer: torch.optim.Optimizer, optim: OptimSection, step: int, total: int) -> float:
    """Set the optimiser's learning rate and beta1 for a step that is about to be made; returns the rate."""
    lr, beta1 = schedule(optim, step, total)
    for group in optimizer.param_groups:
        group["lr"] = lr
        group["betas"] = (beta1, BETA2)
    return lr


class Ema:
    """Exponential moving average of a module's parameters and buffers.

    The weight of the past is min(decay, (1 + n) / (10 + n)) at update n, so that the first, random weights are soon
    forgotten. Whole-number buffers are copied.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.module = copy.deepcopy(module).eval().requires_grad_(False)
        """The averaged module, in evaluation mode."""
        self.decay = decay
        self.updates = 0
        ours, theirs = self.module.state_dict(keep_vars=True), module.state_dict(keep_vars=True)
        averaged = [name for name, value in theirs.items() if value.is_floating_point()]
        self._pairs = [(ours[name], theirs[name]) for name in averaged]
        self._copied = [(ours[name], theirs[name]) for name in theirs if name not in set(averaged)]

    @torch.no_grad()
    def update(self) -> None:
        """Take in the source module's present weights."""
        self.updates += 1
        keep = min(self.decay, (1 + self.updates) / (10 + self.updates))
        ours: list[Tensor] = [mine for mine, _ in self._pairs]
        torch._foreach_lerp_(ours, [source.detach() for _, source in self._pairs], 1 - keep)
        for mine, source in self._copied:
            mine.copy_(source)
