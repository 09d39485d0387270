"""How the benchmarks measure a time."""

from __future__ import annotations

import time
from collections.abc import Callable


def shortest(run: Callable[[], object], times: int = 10) -> float:
    """Return the shortest of several times, in seconds; the first run is not counted."""
    run()
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        taken.append(time.perf_counter() - start)
    return min(taken)
