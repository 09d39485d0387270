"""How CPU kernels are compiled: by numba, once, without the interpreter's lock.

Kernels run on the calling thread; :func:`parallel_for` spreads the long ones over as many threads as PyTorch may
use. Plain threads are used rather than numba's own, whose pools may neither be entered by two threads at a time nor be
used before a fork, and data loaders do both.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from threading import Lock
from typing import Any

import numba
import torch
from numba.core import event

from beambox.progress import CompileNotice

__all__ = ["jit", "jit_fastmath", "parallel_for"]


class _Compiled(event.Listener):
    """Hears of each kernel of ours that numba compiles; those that it finds on disk are no such event."""

    notice = CompileNotice()

    def on_start(self, event: event.Event) -> None:
        """Say so, where somebody is waiting at a terminal."""
        function = getattr((event.data or {}).get("dispatcher"), "py_func", None)
        if getattr(function, "__module__", "").startswith("beambox."):
            self.notice()

    def on_end(self, event: event.Event) -> None:
        """Nothing: the result says that it is done."""


event.register("numba:compile", _Compiled())


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel on its first call; keep the machine code on disk where a folder can be written.

    No ``fastmath``: kernels round as the reference does.
    """
    return _compile(function, fastmath=False)


def jit_fastmath(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel as :func:`jit` does, but let it add in another order and fuse a product with its sum.

    For long dot products, which use the processor's vectors only so. NaN and infinity are still honoured.
    """
    return _compile(function, fastmath={"reassoc", "nsz", "contract"})


def _compile(function: Callable[..., Any], fastmath: bool | set[str]) -> Callable[..., Any]:
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath)(function)
    except RuntimeError:  # numba found no folder for its cache
        return numba.njit(nogil=True, error_model="numpy", fastmath=fastmath)(function)


PIECES = 4
"""Blocks a thread: one that another program holds up then leaves its share to the others."""


def parallel_for(kernel: Callable[[int, int], None], length: int, smallest: int = 1) -> None:
    """Run ``kernel(start, stop)`` over ``0 .. length`` in blocks, each taken by the next free thread.

    Blocks must be independent, so that the result does not depend on their number or order.

    Args:
        kernel: releases the interpreter's lock, or nothing is won.
        length: number of items.
        smallest: no block is shorter, as starting a thread takes about 0.1 ms.
    """
    most = max(1, length // max(1, smallest))
    threads = min(torch.get_num_threads(), most)
    if threads <= 1:
        kernel(0, length)
        return
    blocks = min(PIECES * threads, most)
    edges = [length * i // blocks for i in range(blocks + 1)]
    left, lock = iter(pairwise(edges)), Lock()

    def work() -> None:
        while True:
            with lock:
                block = next(left, None)
            if block is None:
                return
            kernel(*block)

    with ThreadPoolExecutor(threads - 1) as pool:
        waiting = [pool.submit(work) for _ in range(threads - 1)]
        work()
        for helper in waiting:
            helper.result()
