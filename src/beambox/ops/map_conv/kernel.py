"""What a convolution of maps is made of, and a pair of maps that belong together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from beambox.checks import BeamboxError

__all__ = ["Folded", "Ground", "MapKernel"]

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class MapKernel:
    """A convolution, or a transposed one, with bias, and ReLU where asked for; all as :func:`torch.conv2d` has it."""

    weight: Tensor
    """``(C_out, C_in, kh, kw)``, or ``(C_in, C_out, kh, kw)`` where transposed."""
    bias: Tensor | None = None
    """``(C_out,)``."""
    stride: int = 1
    padding: int = 0
    dilation: int = 1
    transposed: bool = False
    output_padding: int = 0
    """Rows and columns more at the end, where transposed."""
    relu: bool = False
    _kept: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if self.weight.ndim != 4:
            raise BeamboxError(f"`weight` must have 4 dimensions, got shape {tuple(self.weight.shape)}")

    @property
    def in_channels(self) -> int:
        """Channels of the input."""
        return self.weight.shape[0 if self.transposed else 1]

    @property
    def out_channels(self) -> int:
        """Channels of the output."""
        return self.weight.shape[1 if self.transposed else 0]

    def size(self, size: Sequence[int]) -> tuple[int, int]:
        """Return the output's size (y, x) for an input's."""
        y, x = (self._length(n, k) for n, k in zip(size, self.weight.shape[2:]))
        return y, x

    def _length(self, length: int, kernel: int) -> int:
        reach = self.dilation * (kernel - 1)
        if self.transposed:
            return (length - 1) * self.stride - 2 * self.padding + reach + self.output_padding + 1
        return (length + 2 * self.padding - reach - 1) // self.stride + 1

    def tensors(self) -> tuple[Tensor, ...]:
        """Return weight and bias."""
        return (self.weight,) if self.bias is None else (self.weight, self.bias)

    def state(self) -> tuple[int, ...]:
        """Return what changes with the weights; not to be asked of inference tensors, which do not count changes."""
        return tuple(n for tensor in self.tensors() for n in (tensor.data_ptr(), tensor._version))

    def kept(self, name: str, make: Callable[[MapKernel], T]) -> T:
        """Return what was made of the weights, made anew once they have changed."""
        state = self.state()
        made = self._kept.get(name)
        if made is None or made[0] != state:
            made = self._kept[name] = (state, make(self))
        return made[1]


@dataclass(frozen=True, eq=False)
class Ground:
    """What a convolution answers to one certain map, usually that of empty ground.

    Far from the borders all cells are alike, so only distinct rows and columns are held: the map's cell (y, x) is
    ``table[row[y], column[x]]``.
    """

    given: Folded
    """The convolution's input."""
    answer: Folded
    """Its output."""
    state: tuple[Any, ...]
    """Of the weights that it was computed with."""


@dataclass(frozen=True, eq=False)
class Folded:
    """A map ``(1, C, Y, X)`` of which only distinct rows and columns are held."""

    table: Tensor
    """``(R, K, C)`` cells."""
    row: Tensor
    """``(Y,)`` int64."""
    column: Tensor
    """``(X,)`` int64."""

    @classmethod
    def of(cls, bev: Tensor) -> Folded:
        """Fold one map; bits decide what is equal."""
        cells = bev[0].permute(1, 2, 0).contiguous()  # (Y, X, C)
        row, first_row = distinct(cells)
        column, first_column = distinct(cells[first_row].transpose(0, 1))
        return cls(cells[first_row][:, first_column].contiguous(), row, column)

    def unfolded(self) -> Tensor:
        """Return the map."""
        return self.table[self.row][:, self.column].permute(2, 0, 1)[None]


def distinct(lines: Tensor) -> tuple[Tensor, Tensor]:
    """Return, for ``(N, ...)`` lines, which of the distinct ones each is, and where each distinct one occurs first."""
    seen: dict[bytes, int] = {}
    first, which = [], []
    for place, line in enumerate(lines.contiguous().numpy()):
        number = seen.setdefault(line.tobytes(), len(seen))
        if number == len(first):
            first.append(place)
        which.append(number)
    return torch.tensor(which), torch.tensor(first)
