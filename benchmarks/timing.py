"""How the benchmarks measure time and memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path


def shortest(run: Callable[[], object], times: int = 10) -> float:
    """Return the shortest of several times, in seconds; the first run is not counted."""
    run()
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        taken.append(time.perf_counter() - start)
    return min(taken)


def memory_added(run: Callable[[], object]) -> int:
    """Return by how many bytes the process's memory rises at most while something runs; on Linux."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew; ru_maxrss would begin with the parent's
    before = _resident("VmRSS")
    run()
    return _resident("VmHWM") - before


def _resident(entry: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{entry}:"))
