"""Devices, precision and processes of a training run, through lightning's Fabric."""

from __future__ import annotations

import os
from datetime import timedelta
from typing import TYPE_CHECKING

import torch

from beambox.checks import BeamboxError, expect_library
from beambox.infer.precision import bfloat16_reason

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = ["choose_precision", "make_fabric"]

FABRIC_PRECISION = {"float32": "32-true", "bfloat16": "bf16-mixed", "float16": "16-mixed"}

PATIENCE = timedelta(hours=4)
"""How long processes wait for each other: cutting objects out of a large data set is one process's work."""


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
    return "float32" if bfloat16_reason(torch.device(device), training=True) else "bfloat16"


def make_fabric(precision: str) -> Fabric:
    """Set up Fabric for this process: one device, or, under torchrun, one of many.

    Args:
        precision: as in a recipe.

    Raises:
        BeamboxError: if lightning-fabric is not installed.
    """
    expect_library("lightning_fabric", "train", "training")
    from lightning_fabric import Fabric
    from lightning_fabric.strategies import DDPStrategy

    device = "cuda" if torch.cuda.is_available() else "cpu"
    chosen = choose_precision(precision, device)
    world = int(os.environ.get("WORLD_SIZE", "1")) if "TORCHELASTIC_RUN_ID" in os.environ else 1
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    many = world > 1
    fabric = Fabric(
        accelerator=device,
        devices=local if many else 1,
        num_nodes=max(1, world // local) if many else 1,
        strategy=DDPStrategy(timeout=PATIENCE) if many else "auto",
        precision=FABRIC_PRECISION[chosen],  # pyright: ignore[reportArgumentType]
    )
    fabric.launch()
    return fabric
