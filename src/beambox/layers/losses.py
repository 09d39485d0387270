"""Losses of anchor heads (focal: Lin et al. 2017; sine difference: SECOND, section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["sigmoid_focal", "sine_difference", "smooth_l1"]


def sigmoid_focal(logits: Tensor, targets: Tensor, alpha: float = 0.25, gamma: float = 2.0) -> Tensor:
    """Focal loss of independent binary decisions, element by element.

    Args:
        logits: any shape.
        targets: the same shape, values in [0, 1].
        alpha: weight of positives; negatives weigh ``1 - alpha``.
        gamma: how fast well-decided elements fade.

    Returns:
        The loss of each element, not reduced.
    """
    probability = torch.sigmoid(logits)
    miss = targets * (1 - probability) + (1 - targets) * probability
    weight = (targets * alpha + (1 - targets) * (1 - alpha)) * miss.pow(gamma)
    return weight * functional.binary_cross_entropy_with_logits(logits, targets, reduction="none")


def smooth_l1(difference: Tensor, beta: float = 1 / 9) -> Tensor:
    """Quadratic below ``beta``, linear above, element by element."""
    size = difference.abs()
    return torch.where(size < beta, 0.5 * size * size / beta, size - 0.5 * beta)


def sine_difference(predicted: Tensor, target: Tensor) -> Tensor:
    """Difference of ``(..., 7)`` box deltas with the angle's replaced by ``sin(predicted - target)``.

    A box turned by half a turn then costs nothing: telling front from rear is the direction classifier's work.
    """
    plain = predicted[..., :6] - target[..., :6]
    return torch.cat((plain, torch.sin(predicted[..., 6:7] - target[..., 6:7])), dim=-1)
