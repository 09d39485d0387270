"""Several sources as one, with a share of every epoch each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beambox.checks import BeamboxError, expect_same_length
from beambox.data.sampling import shuffled_indices
from beambox.data.source import FrameSource
from beambox.structures import Frame

__all__ = ["MixedSource"]

# streams of random numbers that must not meet others: the object database has 2, training 11 and 12. A key that ends in
# zeros is the same stream as one without them, so keys of different lengths need numbers of their own
ORDER, SHUFFLE = 0, 3


@dataclass(frozen=True)
class MixedSource:
    """Several sources as one, with a share of every epoch each."""

    sources: Sequence[FrameSource]
    """Where the frames come from."""
    weights: Sequence[float] | None = None
    """Share of each source in an epoch, in any unit; None takes every frame once."""
    epoch_length: int | None = None
    """Frames an epoch; None takes as many as there are."""

    def __post_init__(self) -> None:
        if not self.sources:
            raise BeamboxError("a mixture needs at least one source, got none")
        if self.weights is not None:
            expect_same_length(weights=len(self.weights), sources=len(self.sources))
            if min(self.weights) < 0 or sum(self.weights) <= 0:
                raise BeamboxError(f"`weights` must be at least 0 and not all 0, got {list(self.weights)}")

    @property
    def ids(self) -> list[str]:
        """Names of the frames, with the number of the source before them so that they stay unique."""
        return [f"{k}:{name}" for k, source in enumerate(self.sources) for name in source.ids]

    def __len__(self) -> int:
        return sum(len(source) for source in self.sources)

    def __getitem__(self, index: int) -> Frame:
        for source in self.sources:
            if index < len(source):
                return source[index]
            index -= len(source)
        raise IndexError(index)

    def epoch_indices(self, seed: int, epoch: int) -> np.ndarray:
        """Return the frames of an epoch, shuffled: a pure function of its arguments.

        Each source is walked through, so that none of its frames repeats before all came.
        """
        sizes = np.array([len(source) for source in self.sources])
        weights = sizes if self.weights is None else np.array(self.weights)
        length = self.epoch_length or int(sizes.sum())
        ends = np.round(np.cumsum(weights) / weights.sum() * length).astype(np.int64)
        counts = np.diff(ends, prepend=0)
        first = np.cumsum(sizes) - sizes
        parts = [
            first[k] + shuffled_indices(int(sizes[k]), epoch * count, count, (seed, ORDER, k))
            for k, count in enumerate(counts.tolist())
            if count
        ]
        return np.random.default_rng((seed, SHUFFLE, epoch)).permutation(np.concatenate(parts))
