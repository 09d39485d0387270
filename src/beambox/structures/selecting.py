"""What the values share: how they are indexed, and when two are equal."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, SupportsIndex, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beambox.checks import BeamboxError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["Index", "as_numbers", "floats", "integers", "positions", "rows_of", "same_fields"]

Index = slice | Sequence[int] | Sequence[bool] | Tensor | NDArray[np.bool_] | NDArray[np.integer[Any]]
"""What selects several entries: a slice, a mask of the whole length, or positions."""


def positions(index: Index | SupportsIndex, length: int) -> Tensor | int:
    """Turn what a user writes between brackets into positions: one number, or ``(K,)`` int64.

    Raises:
        IndexError: if a position lies outside, as lists do.
        BeamboxError: if a mask has another length, or it is no index at all.
    """
    if isinstance(index, slice):
        return torch.tensor(range(length)[index], dtype=torch.int64)
    if not isinstance(index, Sequence) and getattr(index, "ndim", 0) == 0:
        return _position(index, length)
    try:
        chosen = torch.as_tensor(index).cpu()
    except (TypeError, ValueError, RuntimeError):
        raise _no_index(index) from None
    if chosen.dtype == torch.bool:
        if chosen.shape != (length,):
            raise BeamboxError(f"a mask needs one value for each of the {length} entries, got {tuple(chosen.shape)}")
        return chosen.nonzero()[:, 0]
    if chosen.numel() == 0:
        return torch.zeros(0, dtype=torch.int64)
    if chosen.dim() != 1 or chosen.is_floating_point() or chosen.is_complex():
        raise _no_index(index)
    outside = [i for i in integers(chosen) if not -length <= i < length]
    if outside:
        raise IndexError(f"position {outside[0]} lies outside of {length} entries")
    return torch.where(chosen < 0, chosen + length, chosen).to(torch.int64)


def _position(index: object, length: int) -> int:
    try:
        position = operator.index(cast("SupportsIndex", index))  # refused below where it is none
    except TypeError:
        raise _no_index(index) from None
    if isinstance(index, bool) or getattr(index, "dtype", None) in (torch.bool, np.dtype(bool)):
        raise _no_index(index)
    if not -length <= position < length:
        raise IndexError(f"position {position} lies outside of {length} entries")
    return position % length


def _no_index(index: object) -> BeamboxError:
    return BeamboxError(f"an index is a number, a slice, a mask or a list of positions, got {index!r:.80}")


def floats(values: Tensor) -> list[float]:
    """Return ``(N,)`` values as Python's numbers."""
    return values.tolist()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]  # as torch types it


def rows_of(values: Tensor) -> list[list[float]]:
    """Return ``(N, C)`` values as Python's numbers."""
    return values.tolist()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]  # as torch types it


def integers(values: Tensor) -> list[int]:
    """Return ``(N,)`` whole numbers as Python's."""
    return values.tolist()  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]  # as torch types it


def same_fields(one: DataclassInstance, other: DataclassInstance) -> bool:
    """Whether every field of two values of one class is equal; tensors value by value, wherever they lie."""
    return all(_same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))


def _same(one: object, other: object) -> bool:
    """Whether two fields are equal; tensors by type, shape and every value, on whatever device."""
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        return one.dtype == other.dtype and one.shape == other.shape and torch.equal(one.cpu(), other.cpu())
    return one == other


def as_numbers(name: str, values: object, dtype: torch.dtype) -> Tensor:
    """Turn an array or a list into a tensor; a tensor of numbers of the same kind stays as it is.

    Raises:
        BeamboxError: if it does not hold numbers, or fractions where whole numbers are expected.
    """
    if isinstance(values, Tensor) and values.is_floating_point() and dtype.is_floating_point:
        return values
    try:
        listed = isinstance(values, list | tuple)
        tensor = torch.as_tensor(np.asarray(cast("Sequence[object]", values)) if listed else values)
    except (TypeError, ValueError, RuntimeError):
        raise BeamboxError(f"`{name}` must hold numbers, got {values!r:.80}") from None
    if tensor.dtype.is_complex or (tensor.is_floating_point() and not dtype.is_floating_point and tensor.numel()):
        raise BeamboxError(f"`{name}` must hold {'real' if dtype.is_floating_point else 'whole'} numbers, got "
                           f"{str(tensor.dtype).removeprefix('torch.')}")  # fmt: skip
    return tensor.to(dtype)
