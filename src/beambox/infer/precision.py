"""Which number format a network runs in: the fast one only where the machine computes it natively."""

from __future__ import annotations

from typing import Literal

import torch

from beambox.checks import BeamboxError, did_you_mean

__all__ = ["PRECISIONS", "Precision", "bfloat16_reason", "choose_device", "choose_precision"]

Precision = Literal["auto", "float32", "bfloat16", "float16"]
PRECISIONS: dict[str, torch.dtype] = {
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}


def bfloat16_reason(device: torch.device, *, training: bool = False) -> str | None:
    """Say why bfloat16 would not be faster on a device, or return None where it would.

    On a CPU with AVX512-BF16 but without AMX, training gains from it; detection does not, which in float32 leaves out
    empty ground and half of the multiplications of 3 x 3 convolutions (``benchmarks/peers.py`` measures both).
    """
    if device.type == "cuda":
        major, minor = torch.cuda.get_device_capability(device)
        if major < 8:
            return f"this GPU has compute capability {major}.{minor}, bfloat16 needs 8.0"
        return None
    if device.type == "cpu":
        # torch has no public question for these two; without them bfloat16 is emulated and slower than float32
        if torch.cpu._is_amx_tile_supported() or (training and torch.cpu._is_avx512_bf16_supported()):
            return None
        return "this CPU has neither AMX nor AVX512-BF16" if training else "this CPU has no AMX"
    return f"not measured on {device.type}"


def choose_precision(precision: str, device: torch.device) -> torch.dtype:
    """Turn a user's word into an element type; "auto" is bfloat16 where it is faster, else float32.

    Raises:
        BeamboxError: for an unknown word.
    """
    if precision == "auto":
        return torch.float32 if bfloat16_reason(device) else torch.bfloat16
    if precision not in PRECISIONS:
        raise BeamboxError(f'unknown precision "{precision}"{did_you_mean(precision, ["auto", *PRECISIONS])}')
    return PRECISIONS[precision]


def choose_device(device: str | torch.device | None) -> torch.device:
    """Turn a user's word into a device; None is the GPU where there is one, else the CPU.

    Raises:
        BeamboxError: if it is no device, or not one that this machine has.
    """
    if device is None or device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        chosen = torch.device(device)
    except RuntimeError:
        raise BeamboxError(f'unknown device "{device}"; expected cpu, cuda, or cuda:0') from None
    if chosen.type == "cuda" and not torch.cuda.is_available():
        why = "this torch was built without CUDA" if torch.version.cuda is None else "torch finds no GPU"
        raise BeamboxError(f'device "{device}" cannot be used: {why}; use cpu (`beambox doctor` says more)')
    if chosen.type == "cuda" and (chosen.index or 0) >= torch.cuda.device_count():
        raise BeamboxError(f'device "{device}" is not there; this machine has {torch.cuda.device_count()}')
    return chosen
