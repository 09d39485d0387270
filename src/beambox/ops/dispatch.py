"""Which version of an operation runs: a flat list, best first, each backend saying why it cannot run.

The environment variable ``BEAMBOX_BACKEND`` pins one of ``reference``, ``numba`` and ``triton``. A pinned backend that
cannot run raises with its reason; an operation that has no version of the pinned kind runs its reference. A version
called ``graph`` runs while a network is exported, whatever is pinned: it needs sizes alone and no values.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from beambox.checks import BeamboxError, did_you_mean

__all__ = [
    "BACKEND_NAMES",
    "Backend",
    "always",
    "can_run_graph",
    "can_run_numba",
    "can_run_triton",
    "choose",
    "exporting",
    "needs_gradient",
    "pinned",
    "waiting_is_dear",
]

BACKEND_NAMES = ("reference", "numba", "triton")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Backend:
    """One version of an operation."""

    name: str
    """One of ``BACKEND_NAMES``, or ``graph``, which is never pinned."""
    can_run: Callable[..., str | None]
    """Given the operation's tensors, the reason why this backend cannot run on them, or None."""
    load: Callable[[], Callable[..., Any]]
    """Import and return the version; numba and Triton are loaded no earlier than this."""


def always(*tensors: Tensor) -> None:
    """Return None: the plain PyTorch reference runs anywhere."""


def exporting() -> bool:
    """Tell whether ``torch.export`` traces a graph: sizes are known then, values are not, so none can be checked."""
    return torch.compiler.is_exporting()


def can_run_graph(*tensors: Tensor) -> str | None:
    """Return why the version made for exported graphs does not run, or None."""
    return None if exporting() else "no graph is being exported"


def can_run_numba(*tensors: Tensor) -> str | None:
    """Return why numba cannot run on these tensors, or None."""
    if not _installed("numba"):
        return "numba is not installed"
    for tensor in tensors:
        if tensor.device.type != "cpu":
            return f"a tensor is on {tensor.device}, numba runs on the CPU"
        if tensor.is_floating_point() and tensor.dtype not in (torch.float32, torch.float64):
            return f"a tensor is {str(tensor.dtype).removeprefix('torch.')}, the numba version takes float32 or float64"
    return None


def can_run_triton(*tensors: Tensor) -> str | None:
    """Return why Triton cannot run on these tensors, or None.

    On the CPU Triton only interprets its kernels, slowly: for tests, ``TRITON_INTERPRET=1`` and
    ``BEAMBOX_BACKEND=triton`` together allow it.
    """
    if not _installed("triton"):
        return "triton is not installed"
    interpreted = os.environ.get("TRITON_INTERPRET") == "1" and pinned() == "triton"
    for tensor in tensors:
        if tensor.device.type != "cuda" and not (interpreted and tensor.device.type == "cpu"):
            return f"a tensor is on {tensor.device}, Triton needs a CUDA device (or TRITON_INTERPRET=1 to be tested)"
    return None


def needs_gradient(*tensors: Tensor) -> bool:
    """Tell whether autograd would record an operation on these tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def pinned() -> str | None:
    """Return the backend named by ``BEAMBOX_BACKEND``, or None where the variable is absent or empty."""
    name = os.environ.get("BEAMBOX_BACKEND", "")
    if name and name not in BACKEND_NAMES:
        known = ", ".join(BACKEND_NAMES)
        raise BeamboxError(f"BEAMBOX_BACKEND must be one of {known}, got {name!r}{did_you_mean(name, BACKEND_NAMES)}")
    return name or None


def waiting_is_dear(tensor: Tensor) -> bool:
    """Tell whether the host should not ask what a tensor holds: it would wait for all that a GPU was given before.

    There sizes are kept fixed, and read once at the end. On the CPU exact sizes are faster.
    """
    return pinned() in (None, "triton") and can_run_triton(tensor) is None


def choose(operation: str, backends: Sequence[Backend], *tensors: Tensor) -> Callable[..., Any]:
    """Return the first backend of the list that can run, or the pinned one.

    Args:
        operation: name for the log and for errors.
        backends: best first; the last one must be the reference.
        tensors: what decides, handed to each ``can_run``.

    Raises:
        BeamboxError: if a backend is pinned and cannot run on these tensors.
    """
    pin = None if exporting() else pinned()
    if pin is not None:
        backend = next((b for b in backends if b.name == pin), backends[-1])
        reason = backend.can_run(*tensors)
        if reason is not None:
            raise BeamboxError(
                f"{operation}: BEAMBOX_BACKEND={pin} asks for the {pin} version, but {reason}; unset the variable "
                f"to let beambox choose"
            )
        _log_once(operation, backend.name, f"BEAMBOX_BACKEND={pin}")
        return backend.load()
    refusals = []
    for backend in backends:
        reason = backend.can_run(*tensors)
        if reason is None:
            _log_once(operation, backend.name, "; ".join(refusals) or "best of the list")
            return backend.load()
        refusals.append(f"not {backend.name}: {reason}")
    raise BeamboxError(f"{operation}: no backend can run ({'; '.join(refusals)})")


@cache
def _installed(package: str) -> bool:
    return find_spec(package) is not None


@cache
def _log_once(operation: str, name: str, why: str) -> None:
    logger.debug("%s runs its %s version (%s)", operation, name, why)
