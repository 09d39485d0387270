"""What commands say while they work: results on stdout, everything else on stderr."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterable, Iterator
from typing import Any, TextIO

from beambox import __version__
from beambox.checks import printable
from beambox.progress import track as progress

__all__ = ["LONGEST_LINE", "announce", "log", "plain", "plain_output", "progress", "show_log"]

LONGEST_LINE = 2000
"""Characters of a message; a file can hold a name of any length."""
BARS = str.maketrans(dict(zip("▁▂▃▄▅▆▇█", "_.:-=+*#")))
"""What stands for the bars of a histogram where the terminal has no such letters (cp1252)."""


def plain(text: str, encoding: str | None, limit: int | None = None) -> str:
    """Return text as a terminal can show it: nothing steers it, and letters it lacks are escapes."""
    shown = printable(text, limit)
    try:
        shown.encode(encoding or "utf-8")
        return shown
    except UnicodeEncodeError:
        known = encoding or "utf-8"
    except LookupError:
        known = "ascii"
    return shown.translate(BARS).encode(known, "backslashreplace").decode(known)


def log(message: str) -> None:
    """Print a line for the person at the terminal, on stderr, so that results can be piped."""
    print(plain(message, sys.stderr.encoding, LONGEST_LINE), file=sys.stderr)


class _Plain:
    """A text stream through which only what :func:`plain` returns passes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, and return how many characters were given."""
        self._stream.write(plain(text, self._stream.encoding))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def plain_output() -> Iterator[None]:
    """Let results pass to stdout without what would steer a terminal, whatever the names in files hold."""
    with contextlib.redirect_stdout(_Plain(sys.stdout)):  # pyright: ignore[reportArgumentType]  # it writes as one
        yield


def announce(command: str, *, seed: int | None = None, detail: str = "") -> None:
    """Say which version runs and with which seed: what a run needs to be repeated."""
    parts = [f"beambox {__version__} {command}"]
    parts += [f"seed {seed}"] if seed is not None else []
    parts += [detail] if detail else []
    log(", ".join(parts))


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
        log(f"beambox: {record.getMessage()}")
