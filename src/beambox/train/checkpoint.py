"""Checkpoints: tensors as safetensors, everything else as JSON inside; loading one never runs code from it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from beambox.checks import BeamboxError, MissingFileError
from beambox.io import parse_json, write_bytes

__all__ = ["Checkpoint", "load_checkpoint", "optimizer_state", "part", "restore_module", "restore_optimizer"]

FORMAT = "beambox-checkpoint-1"


@dataclass
class Checkpoint:
    """All that a run needs to go on exactly as if it had never stopped."""

    tensors: dict[str, Tensor]
    """Weights (``model.*``), their average (``ema.*``) and the optimiser's moments (``optim.*``)."""
    step: int
    """Optimiser steps made."""
    recipe: dict[str, Any]
    """The recipe, as plain values."""
    detector: dict[str, Any]
    """The detector's name and full config, as plain values."""
    state: dict[str, Any] = field(default_factory=dict)
    """Counters, scaler, best score so far: plain values."""

    def save(self, path: Path) -> None:
        """Write to ``path``; a failure leaves what stood there before untouched.

        Raises:
            BeamboxError: if the file cannot be written, as on a full disk.
        """
        plain = {"step": self.step, "recipe": self.recipe, "detector": self.detector, "state": self.state}
        metadata = {"format": FORMAT, "beambox": json.dumps(plain)}
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.tensors.items()}
        former = path.exists()
        try:
            write_bytes(path, save(tensors, metadata), sync=True)
        except BeamboxError as error:
            kept = "the former checkpoint is intact" if former else "no checkpoint was there before"
            raise BeamboxError(f"{error}; {kept}; free some space and go on with --resume") from error


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: if it is pickled, cut short, or not a checkpoint of a run.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"there is no checkpoint {path}; leave out --resume to start afresh")
    with path.open("rb") as file:
        start = file.read(9)
    # a .safetensors file begins with the length of its header, whose bytes may be those of the others, and then has "{"
    if (start[:1] == b"\x80" or start[:2] == b"PK") and start[8:] != b"{":
        raise BeamboxError(
            f"{path} is a pickled PyTorch file; beambox does not load these because unpickling can run any code; "
            "a checkpoint of beambox is a .safetensors file"
        )
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise BeamboxError(
                    f"{path} holds no state of a training run (format {metadata.get('format', 'unknown')}, expected "
                    f"{FORMAT}); resume from the file last.safetensors of the run's folder"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise BeamboxError(f"{path} is damaged or cut short ({error}); resume from another checkpoint") from None
    plain = parse_json(metadata.get("beambox", "null"), str(path))
    try:
        return Checkpoint(tensors, plain["step"], plain["recipe"], plain["detector"], plain["state"])
    except (LookupError, TypeError):
        raise BeamboxError(f"{path} is a damaged checkpoint: its header lacks a part; resume from another") from None


def part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Select the tensors whose name starts with ``prefix`` and cut it off."""
    return {name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def restore_module(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy tensors into a module's parameters and buffers.

    Raises:
        BeamboxError: if a tensor is missing, superfluous or of another shape: these are weights of another model.
    """
    own = module.state_dict()
    faults = [f"{name} is missing" for name in own if name not in tensors]
    faults += [f"{name} is not part of the model" for name in tensors if name not in own]
    faults += [
        f"{name} has shape {tuple(tensors[name].shape)}, the model {tuple(own[name].shape)}"
        for name in own
        if name in tensors and tensors[name].shape != own[name].shape
    ]
    if faults:
        more = f" and {len(faults) - 3} more" if len(faults) > 3 else ""
        raise BeamboxError(f"{where} holds the weights of another model: {'; '.join(faults[:3])}{more}")
    module.load_state_dict(dict(tensors))


def optimizer_state(optimizer: torch.optim.Optimizer, names: Mapping[nn.Parameter, str]) -> dict[str, Tensor]:
    """Return the optimiser's state as ``optim.<parameter>.<moment>`` tensors."""
    return {
        f"optim.{names[parameter]}.{moment}": value  # pyright: ignore[reportArgumentType]
        for parameter, moments in optimizer.state.items()
        for moment, value in moments.items()
    }


def restore_optimizer(
    optimizer: torch.optim.Optimizer, names: Mapping[nn.Parameter, str], tensors: Mapping[str, Tensor]
) -> None:
    """Put state written by :func:`optimizer_state` (prefix ``optim.`` cut off) back."""
    for parameter, name in names.items():
        moments = part(tensors, f"{name}.")
        for moment, value in moments.items():
            # a step counter stays on the CPU, moments live beside their parameter, in its memory format
            like = parameter if value.dim() else value
            optimizer.state[parameter][moment] = (
                torch.empty_like(like, requires_grad=False).copy_(value) if value.dim() else value.clone()
            )
