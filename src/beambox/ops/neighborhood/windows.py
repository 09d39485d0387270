"""Which pixels a pixel attends to."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["queries_of", "window_start"]


def window_start(length: int, window: int, device: torch.device | str | None = None) -> Tensor:
    """Return where the window of each row (or column) starts: ``(length,)`` int64.

    The window is centred, and shifted inside at the borders: it always has its full size.
    """
    return (torch.arange(length, device=device) - window // 2).clamp(0, length - window)


def queries_of(length: int, window: int, device: torch.device | str | None = None) -> Tensor:
    """Tell which rows (or columns) attend to which: ``(3, length)`` int64.

    For each row: where its window starts, the first row whose window holds it, and one past the last such row.
    """
    start = window_start(length, window, device)  # ascending, so the rows that hold a row stand side by side
    rows = torch.arange(length, device=device)
    first = torch.searchsorted(start, rows - window, right=True)
    return torch.stack((start, first, torch.searchsorted(start, rows, right=True)))
