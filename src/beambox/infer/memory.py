"""Keep memory that every sweep needs again."""

from __future__ import annotations

import ctypes
import os
import sys

__all__ = ["keep_memory"]

MMAP_THRESHOLD, TRIM_THRESHOLD = -3, -1  # names of glibc's mallopt(3)
KEPT = 1 << 30
"""Bytes."""

_asked: list[bool] = []


def keep_memory() -> bool:
    """Ask the C library to keep up to 1 GB of freed memory for the next sweep; return whether it does.

    By default glibc gives every freed map of some megabytes back to the system and asks for it again at the next pass,
    which then pays for each page: a third of PointPillars' time. Only glibc is asked, once per process, and not where
    the environment already says how it should handle memory (``MALLOC_...`` or ``GLIBC_TUNABLES``).
    """
    if not _asked:
        _asked.append(False)
        details = any(name.startswith("MALLOC_") or name == "GLIBC_TUNABLES" for name in os.environ)
        mallopt = None if details or sys.platform != "linux" else getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            _asked[0] = bool(mallopt(MMAP_THRESHOLD, KEPT)) and bool(mallopt(TRIM_THRESHOLD, KEPT))
    return _asked[0]
