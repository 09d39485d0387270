"""Where frames come from: anything with a length, items and names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from beambox.checks import BeamboxError, expect_same_length
from beambox.structures import Frame

__all__ = ["FrameList", "FrameSource", "SubsetSource"]


@runtime_checkable
class FrameSource(Protocol):
    """A sequence of frames, read when asked for; must be picklable, so that worker processes can hold it."""

    @property
    def ids(self) -> Sequence[str]:
        """Name of each frame, unique in the source."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame: ...


@dataclass(frozen=True)
class FrameList:
    """Frames that are in memory already."""

    frames: Sequence[Frame]

    @property
    def ids(self) -> list[str]:
        """Name of each frame."""
        return [frame.id for frame in self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        return self.frames[index]


@dataclass(frozen=True)
class SubsetSource:
    """Some frames of another source, in the order given."""

    source: FrameSource
    indices: Sequence[int]

    def __post_init__(self) -> None:
        size = len(self.source)
        wrong = [i for i in self.indices if not 0 <= i < size]
        if wrong:
            raise BeamboxError(f"`indices` must lie in 0 to {size - 1}, the source's frames; got {wrong[0]}")
        expect_same_length(ids=len(self.source.ids), source=size)

    @property
    def ids(self) -> list[str]:
        """Name of each frame."""
        names = self.source.ids
        return [names[i] for i in self.indices]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> Frame:
        return self.source[self.indices[index]]
