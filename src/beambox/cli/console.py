"""What commands say while they work: results on stdout, everything else on stderr."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from beambox import __version__

__all__ = ["announce", "progress", "say", "show_log"]

T = TypeVar("T")


def say(message: str) -> None:
    """Print a line for the person at the terminal, on stderr, so that results can be piped."""
    print(message, file=sys.stderr)


def announce(command: str, *, seed: int | None = None, detail: str = "") -> None:
    """Say which version runs and with which seed: what a run needs to be repeated."""
    parts = [f"beambox {__version__} {command}"]
    parts += [f"seed {seed}"] if seed is not None else []
    parts += [detail] if detail else []
    say(", ".join(parts))


def progress(items: Iterable[T], total: int, what: str) -> Iterator[T]:
    """Yield items, behind a bar on stderr where that is a terminal and there is more than one."""
    if total < 2 or not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(items, description=what, total=total, console=Console(stderr=True))


def show_log(level: int = logging.WARNING) -> None:
    """Let the library's log appear on stderr, one line a record."""
    logger = logging.getLogger("beambox")
    logger.setLevel(level)
    if not any(isinstance(handler, _Lines) for handler in logger.handlers):
        logger.addHandler(_Lines())


class _Lines(logging.Handler):
    """One line on stderr, whatever stderr is by then."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        say(f"beambox: {record.getMessage()}")
