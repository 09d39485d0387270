"""Sampling without replacement, epoch after epoch: an endless shuffled sequence, computed instead of remembered.

Where an iterator would keep a permutation and a pointer, ``shuffled_indices(size, start, count, seed)`` is a pure
function of the position in the sequence. A resumed run, another worker or another rank therefore sees what it would
have seen.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

__all__ = ["shuffled_indices"]


@lru_cache(maxsize=64)
def _permutation(size: int, seed: tuple[int, ...], epoch: int) -> np.ndarray:
    return np.random.default_rng((*seed, epoch)).permutation(size)


def shuffled_indices(size: int, start: int, count: int, seed: tuple[int, ...]) -> np.ndarray:
    """Return items ``start`` to ``start + count`` of the shuffled sequence: ``(count,)`` int64 in [0, size).

    Args:
        size: number of items, at least 1.
        start: position in the endless sequence; each stretch from a multiple of ``size`` to the next is a permutation.
        count: how many.
        seed: non-negative integers that name the sequence.
    """
    flat = np.arange(start, start + count, dtype=np.int64)
    epochs, places = flat // size, flat % size
    out = np.empty(count, dtype=np.int64)
    for epoch in np.unique(epochs).tolist():
        here = epochs == epoch
        out[here] = _permutation(size, seed, epoch)[places[here]]
    return out
