"""Neighbourhood attention by gathering every window, in plain PyTorch: the definition."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.neighborhood.windows import window_start

__all__ = ["neighborhood_attention"]


def neighborhood_attention(q: Tensor, k: Tensor, v: Tensor, bias: Tensor, window: int = 7) -> Tensor:
    """Attend to the window around each pixel; see :func:`beambox.ops.neighborhood.neighborhood_attention`.

    ``softmax(q . k / sqrt(d) + bias) . v`` over the pixels of the window.
    """
    height, width, depth = q.shape[2:]
    rows = window_start(height, window, q.device)[:, None] + torch.arange(window, device=q.device)  # (H, L)
    columns = window_start(width, window, q.device)[:, None] + torch.arange(window, device=q.device)  # (W, L)
    above = rows - torch.arange(height, device=q.device)[:, None] + window - 1  # (H, L) rows of the bias table
    beside = columns - torch.arange(width, device=q.device)[:, None] + window - 1  # (W, L)

    at = (rows[:, None, :, None], columns[None, :, None, :])  # (H, W, L, L)
    near_k, near_v = k[(..., *at, slice(None))], v[(..., *at, slice(None))]  # (B, heads, H, W, L, L, d)
    logits = (q[:, :, :, :, None, None] * near_k).sum(dim=6) / depth**0.5  # (B, heads, H, W, L, L)
    logits = logits + bias[:, above[:, None, :, None], beside[None, :, None, :]]
    weights = logits.flatten(4).softmax(dim=4).view_as(logits)
    return (weights[..., None] * near_v).sum(dim=(4, 5))  # (B, heads, H, W, d)
