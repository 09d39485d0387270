"""Small tensors that never change, made once a device: making one on a GPU waits for all that it was given before."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["constant"]

_MADE: dict[tuple[Any, ...], Tensor] = {}
_MOST = 512


def constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """Return a tensor of (nested) numbers, the same one each time; nobody may write to it.

    Args:
        values: numbers, or tuples of them.
        device: where it lies.
        dtype: its type; PyTorch's choice for the numbers where None.
    """
    if torch.compiler.is_compiling() or torch.compiler.is_exporting():  # what is traced must not outlive the trace
        return torch.tensor(values, device=device, dtype=dtype)
    key = (values, tuple(map(type, values)), device, dtype)  # 1 and 1.0 are equal, and of two types
    found = _MADE.get(key)
    if found is None:
        with torch.inference_mode(False):  # else it could take no part in training later
            found = torch.tensor(values, device=device, dtype=dtype)
        if type(found) is not Tensor:  # a stand-in of a mode that is on
            return found
        if len(_MADE) >= _MOST:
            _MADE.clear()
        _MADE[key] = found
    return found
