"""Names of very many frames, kept as bytes in one array instead of as millions of objects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

__all__ = ["NameList"]


class NameList(Sequence[str]):
    """An unchangeable sequence of names; a million of 13 letters take 13 MB."""

    def __init__(self, names: Iterable[str] | NDArray[np.bytes_]) -> None:
        """Take names over; an array of UTF-8 bytes is kept as it is."""
        if not isinstance(names, np.ndarray):
            names = np.array([name.encode("utf-8") for name in names] or [b""][:0], dtype=np.bytes_)
        self._array = names

    def __len__(self) -> int:
        return len(self._array)

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> NameList: ...
    def __getitem__(self, index: int | slice) -> str | NameList:
        if isinstance(index, slice):
            return NameList(self._array[index])
        return bytes(self._array[index]).decode("utf-8")

    def first_repeated(self) -> str | None:
        """Return a name that occurs more than once, or None."""
        ordered = np.sort(self._array)
        repeated = np.flatnonzero(ordered[1:] == ordered[:-1])
        return bytes(ordered[repeated[0]]).decode("utf-8") if len(repeated) else None

    @classmethod
    def join(cls, parts: Sequence[NameList]) -> NameList:
        """Return all names of several lists, in order."""
        return cls(np.concatenate([part._array for part in parts])) if parts else cls(())
