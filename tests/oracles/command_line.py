"""Run the command line in this process, as a user would in a shell."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from beambox.cli.main import main


@dataclass(frozen=True)
class Ran:
    """What a command left: its exit status and what it printed."""

    status: int
    out: str
    err: str


def beambox(capsys: pytest.CaptureFixture[str], *words: object) -> Ran:
    """Run `beambox WORDS...`."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main([str(word) for word in words])
    printed = capsys.readouterr()
    code = stopped.value.code
    return Ran(code if isinstance(code, int) else 0 if code is None else 1, printed.out, printed.err)
