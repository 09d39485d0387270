"""A bar on stderr for what takes long, where stderr is a terminal."""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

__all__ = ["CompileNotice", "progress_bar", "track"]

T = TypeVar("T")


def track(items: Iterable[T], total: int, what: str, show: bool = True) -> Iterator[T]:
    """Yield items behind a bar, where there is more than one.

    Args:
        items: what to yield.
        total: how many there are.
        what: stands before the bar.
        show: False never shows it.
    """
    if not show or total < 2 or not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track as bar

    yield from bar(items, description=what, total=total, console=Console(stderr=True))


@contextmanager
def progress_bar(what: str, show: bool = True) -> Iterator[Callable[[int, int], None]]:
    """Give a function of (done, total) that moves a bar; it does nothing where there is none."""
    if not show or not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class CompileNotice:
    """Says on a terminal that kernels are being compiled, at the first one and every few seconds after it.

    What would otherwise be silence: a first detection compiles about ten kernels, which takes seconds each on a slow
    machine. Processes that were started to help stay silent, and so does everything where stderr is no terminal.
    """

    every = 3.0
    """Seconds between two lines."""

    def __init__(self) -> None:
        self.count = 0
        self._began = self._last = 0.0

    def __call__(self) -> None:
        """Take note that one more kernel is about to be compiled."""
        self.count += 1
        now = time.monotonic()
        if not self._began:
            self._began = now
            self._write("beambox: compiling kernels for this machine; they are kept, so this happens once ...")
        elif now - self._last >= self.every:
            self._write(f"beambox: compiling kernels, {self.count} so far, {now - self._began:.0f} s ...")
        else:
            return
        self._last = now

    def _write(self, line: str) -> None:
        if sys.stderr is not None and sys.stderr.isatty() and multiprocessing.parent_process() is None:
            print(line, file=sys.stderr, flush=True)
