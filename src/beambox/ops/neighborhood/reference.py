"""Neighbourhood attention by gathering every window, in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.neighborhood.windows import window_start

__all__ = ["neighborhood_attention", "neighborhood_weights"]


def neighborhood_attention(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int = 7) -> Tensor:
    """Attend to the window around each pixel; see :func:`beambox.ops.neighborhood.neighborhood_attention`.

    ``softmax(q . k / sqrt(d) + bias) . v`` over the pixels of the window.
    """
    weights = neighborhood_weights(q, k, bias, window)
    seen = v[(..., *_windows(q.shape[2], q.shape[3], window, q.device), slice(None))]  # (B, heads, H, W, k, k, d)
    return (weights[..., None] * seen).sum(dim=(4, 5))


def neighborhood_weights(q: Tensor, k: Tensor, bias: Tensor, window: int = 7) -> Tensor:
    """Return how much each pixel attends to each of its window: ``(B, heads, H, W, window, window)``, sums of 1."""
    height, width, depth = q.shape[2:]
    at = _windows(height, width, window, q.device)
    above = at[0][:, 0, :, 0] - torch.arange(height, device=q.device)[:, None] + window - 1  # (H, L) rows of the bias
    beside = at[1][0, :, 0, :] - torch.arange(width, device=q.device)[:, None] + window - 1  # (W, L)
    near = k[(..., *at, slice(None))]  # (B, heads, H, W, L, L, d)
    logits = (q[:, :, :, :, None, None] * near).sum(dim=6) / depth**0.5  # (B, heads, H, W, L, L)
    logits = logits + bias[:, above[:, None, :, None], beside[None, :, None, :]]
    return logits.flatten(4).softmax(dim=4).view_as(logits)


def _windows(height: int, width: int, window: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return rows and columns of each pixel's window, ``(H, 1, L, 1), (1, W, 1, L)``."""
    rows = window_start(height, window, device)[:, None] + torch.arange(window, device=device)  # (H, L)
    columns = window_start(width, window, device)[:, None] + torch.arange(window, device=device)  # (W, L)
    return rows[:, None, :, None], columns[None, :, None, :]
