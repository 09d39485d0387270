"""The vocabulary of errors: what was expected, what came, what to do.

Everything a user can cause is a :class:`BeamboxError`; the command line prints it as one line and exits with status 2.
Plain ``assert`` is kept for our own invariants.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line imports this module before it knows whether torch is needed
    import torch
    from torch import Tensor

__all__ = [
    "BeamboxError",
    "MissingFileError",
    "did_you_mean",
    "expect_dtype",
    "expect_finite",
    "expect_same_length",
    "expect_shape",
    "how_to_install",
]


class BeamboxError(ValueError):
    """Something the user gave cannot be used; the message says what was expected, what came and what to do."""


class MissingFileError(BeamboxError, FileNotFoundError):
    """A file or folder that was asked for, or that a format requires, is not there."""

    def __str__(self) -> str:  # FileNotFoundError formats (errno, text); one plain sentence is wanted
        """Return the message as it was given."""
        return str(self.args[0]) if self.args else ""


def expect_shape(name: str, tensor: Tensor, shape: Sequence[int | str | None]) -> None:
    """Check the shape of a tensor.

    Args:
        name: what the tensor is called in the message.
        tensor: the tensor to check.
        shape: one entry a dimension; an ``int`` must match, a ``str`` (a name for the message) or ``None`` may be any.

    Raises:
        BeamboxError: if the number of dimensions or a fixed dimension differs.
    """
    fits = tensor.dim() == len(shape) and all(
        not isinstance(want, int) or want == have for want, have in zip(shape, tensor.shape)
    )
    if not fits:
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise BeamboxError(f"`{name}` must have shape ({wanted}), got {tuple(tensor.shape)}")


def expect_dtype(name: str, tensor: Tensor, *dtypes: torch.dtype) -> None:
    """Check that a tensor has one of the given element types."""
    if tensor.dtype not in dtypes:
        wanted = " or ".join(str(d).removeprefix("torch.") for d in dtypes)
        raise BeamboxError(f"`{name}` must be {wanted}, got {str(tensor.dtype).removeprefix('torch.')}")


def expect_finite(name: str, tensor: Tensor) -> None:
    """Check that a tensor holds neither NaN nor infinity."""
    bad = int((~tensor.isfinite()).sum())
    if bad:
        raise BeamboxError(f"`{name}` must be finite, got {bad} NaN or infinite values of {tensor.numel()}")


def expect_same_length(**lengths: int) -> None:
    """Check that several sequences, given as ``name=len(sequence)``, have one length."""
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"`{name}` has {n}" for name, n in lengths.items())
        raise BeamboxError(f"these must have the same length: {told}")


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """Return `` (did you mean "x"?)`` for the nearest option, or the list of options where none is near."""
    known = sorted(options)
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if near:
        return f' (did you mean "{near[0]}"?)'
    return f" (known: {', '.join(known)})" if known else ""


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra of beambox, which no index holds: from its checkout."""
    return f'python -m pip install ".[{extra}]" in the checkout of beambox'
