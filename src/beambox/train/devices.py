"""Devices, precision and processes of a training run, through lightning's Fabric."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from beambox.checks import BeamboxError

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["choose_precision", "make_fabric"]

FABRIC_PRECISION = {"float32": "32-true", "bfloat16": "bf16-mixed", "float16": "16-mixed"}


def choose_precision(wanted: str, device: str) -> str:
    """Turn ``auto`` into the fastest precision that trains safely on a device.

    Args:
        wanted: ``auto``, ``float32``, ``bfloat16`` or ``float16``.
        device: ``cuda`` or ``cpu``.

    Raises:
        BeamboxError: for float16 on a CPU, which has no use for it.
    """
    if wanted == "float16" and device == "cpu":
        raise BeamboxError("precision float16 needs a GPU; on a CPU take auto, bfloat16 or float32")
    if wanted != "auto":
        return wanted
    if device == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    return "bfloat16" if cpu_has_fast_bfloat16() else "float32"


def cpu_has_fast_bfloat16(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Tell whether the CPU multiplies bfloat16 in hardware (AMX or AVX512-BF16); False where that is not known."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return False
    flags = next((set(line.split(":", 1)[1].split()) for line in lines if line.startswith("flags")), set())
    return bool(flags & {"amx_bf16", "avx512_bf16"})


def make_fabric(precision: str) -> Fabric:
    """Set up Fabric for this process: one device, or, under torchrun, one of many.

    Args:
        precision: as in a recipe.

    Raises:
        BeamboxError: if lightning-fabric is not installed.
    """
    try:
        from lightning_fabric import Fabric
    except ImportError:
        raise BeamboxError("training needs the package lightning-fabric: pip install 'beambox[train]'") from None
    device = "cuda" if torch.cuda.is_available() else "cpu"
    chosen = choose_precision(precision, device)
    world = int(os.environ.get("WORLD_SIZE", "1")) if "TORCHELASTIC_RUN_ID" in os.environ else 1
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    many = world > 1
    fabric = Fabric(
        accelerator=device,
        devices=local if many else 1,
        num_nodes=max(1, world // local) if many else 1,
        strategy="ddp" if many else "auto",
        precision=FABRIC_PRECISION[chosen],  # pyright: ignore[reportArgumentType]
    )
    fabric.launch()
    return fabric
