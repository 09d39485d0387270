"""The `beambox` command: each command is imported only when it is called."""

from __future__ import annotations

import errno
import functools
import inspect
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

from beambox import __version__
from beambox.checks import BeamboxError, did_you_mean
from beambox.cli.commands import COMMANDS

__all__ = ["COMMANDS", "main"]


EXAMPLES = (
    ("beambox demo", "simulate, detect, score, draw: needs no data"),
    ("beambox detect scan.bin --model pointpillars-sim", "find objects in a sweep: writes scan.json"),
    ("beambox show scan.bin --model pointpillars-sim --out scan.png", "and look at them"),
    ("beambox doctor scan.bin", "why are there no detections?"),
    ("beambox simulate data --frames 200 --seed 1", "make a labelled data set"),
    ("beambox train pointpillars-small --data data --out run", "train on it"),
    ("beambox evaluate run --data data", "and score the result"),
)


def help_text() -> str:
    """Return what `beambox --help` prints: worked examples first, then the commands."""
    known = [(text, what) for text, what in EXAMPLES if text.split()[1] in COMMANDS]
    wide = max((len(text) for text, _ in known), default=0)
    lines = [f"beambox {__version__}: LiDAR sweeps in, 3-D boxes out.", "", "Examples:"]
    lines += [f"  {text:<{wide}}  # {what}" for text, what in known]
    lines += ["", "Commands:"]
    lines += [f"  {name:<18} {what}" for name, (_, what) in COMMANDS.items()]
    lines += [
        "",
        "  beambox COMMAND --help   says what a command takes",
        "  beambox --version        says which version this is",
    ]
    return "\n".join(lines)


def guard(function: Callable[..., None]) -> Callable[..., None]:
    """Turn what a user can cause into one line on stderr and an exit status; anything else keeps its traceback."""

    @functools.wraps(function)
    def guarded(*args: object, **kwargs: object) -> None:
        try:
            function(*args, **kwargs)
        except BeamboxError as error:
            stop(str(error), 2)
        except KeyboardInterrupt:
            stop("interrupted; files already written are whole and stay", 130)
        except BrokenPipeError:  # the reader of a pipe has gone, as in `beambox models | head -1`
            sys.stderr.close()
            raise SystemExit(1) from None
        except OSError as error:
            stop(explain(error), 2)

    return guarded


def explain(error: OSError) -> str:
    """Say in one sentence what the operating system refused."""
    where = f"{error.filename}: " if error.filename else ""
    what = error.strerror or str(error)
    hint = ""
    code = errno.errorcode.get(error.errno or 0, "")
    if code in ("ENOSPC", "EDQUOT"):
        hint = "; free some space or give another folder"
    elif code in ("EACCES", "EPERM", "EROFS"):
        hint = "; give a folder that may be written"
    return f"{where}{what}{hint}"


def stop(message: str, status: int) -> NoReturn:
    """Print one line on stderr and leave."""
    from beambox.cli.console import log

    log("beambox: " + " ".join(message.split()))
    raise SystemExit(status)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: words after `beambox`; those of the process where None.

    Raises:
        SystemExit: 0 where all went well, 2 for anything the user can mend, 130 after an interrupt.
    """
    # torch's threads otherwise wait for their next piece of work in a loop of some ms, on a core that others want
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if os.environ.get("_BEAMBOX_WORDS"):
        from beambox.cli.completion import complete

        print("\n".join(complete(words)))
        raise SystemExit(0)
    if not words or words[0] in ("-h", "--help", "help"):
        print(help_text())
        raise SystemExit(0)
    if words[0] in ("-V", "--version"):
        print(f"beambox {__version__}")
        raise SystemExit(0)
    name, rest = words[0], words[1:]
    if name not in COMMANDS:
        stop(f'there is no command "{name}"{did_you_mean(name, COMMANDS)}; see beambox --help', 2)
    run(name, rest)


def run(name: str, arguments: Sequence[str]) -> None:
    """Import one command's module and hand it its arguments."""
    from importlib.metadata import EntryPoint

    import typer

    try:
        command = EntryPoint(name, COMMANDS[name][0], "beambox").load()
    except KeyboardInterrupt:
        stop("interrupted", 130)
    if isinstance(command, typer.Typer):
        app = command
    else:
        app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
        settings = {"help_option_names": ["-h", "--help"]}
        app.command(name, help=help_of(command), context_settings=settings)(guard(command))
    from beambox.cli.console import plain_output

    with plain_output(), terminated_as_interrupted():
        app(args=list(arguments), prog_name=f"beambox {name}")


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM, as a batch system sends it, end a command the way Ctrl-C does: files whole, drafts removed."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    try:
        former = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not in the main thread, where signals do not arrive
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)


def help_of(function: Callable[..., None]) -> str:
    """Return a command's docstring with its examples marked as lines that are not to be joined."""
    text = inspect.cleandoc(function.__doc__ or "")
    return re.sub(r"(?m)(?<!\x08\n)^Examples:$", "\b\nExamples:", text)


if __name__ == "__main__":
    main()
