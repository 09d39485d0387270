"""What a machine reaches at best, to hold a network's time against."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch.nn import functional

__all__ = ["machine_peaks"]

TRIES = 5
"""Runs of each, of which the shortest counts."""


@torch.inference_mode()
def machine_peaks(device: torch.device, dtype: torch.dtype) -> dict[str, float]:
    """Measure PyTorch's convolution, matrix product and copy; takes about half a second on two cores.

    Args:
        device: where.
        dtype: element type of convolution and product.

    Returns:
        ``convolution_gflops`` (3 x 3, 128 channels, 128 x 128 cells, channels last) and ``product_gflops`` (1024
        squared), multiplications and additions counted apart; ``copy_gbs``, 64 MB read and written, in GB/s.
    """
    side, channels, size = 128, 128, 1024
    weight = torch.randn(channels, channels, 3, 3, device=device, dtype=dtype)
    bev = torch.randn(1, channels, side, side, device=device, dtype=dtype).contiguous(memory_format=torch.channels_last)
    weight = weight.contiguous(memory_format=torch.channels_last)
    a, b = torch.randn(2, size, size, device=device, dtype=dtype)
    source = torch.zeros(16 * 1024**2, device=device)
    target = torch.empty_like(source)
    took = {
        "convolution_gflops": (2 * 9 * channels**2 * side**2, lambda: functional.conv2d(bev, weight, padding=1)),
        "product_gflops": (2 * size**3, lambda: a @ b),
        "copy_gbs": (2 * source.numel() * source.element_size(), lambda: target.copy_(source)),
    }
    return {name: round(work / shortest(run, device) / 1e9, 1) for name, (work, run) in took.items()}


def shortest(run: Callable[[], object], device: torch.device) -> float:
    """Return the shortest of some runs in seconds, after one that does not count."""
    best = float("inf")
    for attempt in range(TRIES + 1):
        synchronize(device)
        start = time.perf_counter()
        run()
        synchronize(device)
        if attempt:
            best = min(best, time.perf_counter() - start)
    return best


def synchronize(device: torch.device) -> None:
    """Wait for a GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
