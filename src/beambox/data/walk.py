"""A shuffled walk: an endless sequence that visits every item once a pass, computed instead of remembered.

Where an iterator would keep a permutation and a pointer, ``walk(size, start, count, seed)`` is a pure function of where
in the sequence one stands. A resumed run, another worker or another rank therefore sees what it would have seen.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

__all__ = ["walk"]


@lru_cache(maxsize=64)
def _permutation(size: int, seed: tuple[int, ...], turn: int) -> np.ndarray:
    return np.random.default_rng((*seed, turn)).permutation(size)


def walk(size: int, start: int, count: int, seed: tuple[int, ...]) -> np.ndarray:
    """Return positions ``start`` to ``start + count`` of the walk over ``size`` items: ``(count,)`` int64 in [0, size).

    Args:
        size: number of items, at least 1.
        start: position in the endless sequence; each stretch from a multiple of ``size`` to the next is a permutation.
        count: how many.
        seed: non-negative integers that name the walk.
    """
    flat = np.arange(start, start + count, dtype=np.int64)
    turns, places = flat // size, flat % size
    out = np.empty(count, dtype=np.int64)
    for turn in np.unique(turns).tolist():
        here = turns == turn
        out[here] = _permutation(size, seed, turn)[places[here]]
    return out
