"""The door of the command line: help, names, errors and interrupts."""

from __future__ import annotations

import errno
from importlib.metadata import EntryPoint

import pytest
import typer

from beambox import BeamboxError, __version__
from beambox.cli.main import COMMANDS, EXAMPLES, explain, guard
from oracles.command_line import beambox


def test_help_gives_examples_before_commands_and_names_them_all(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"], ["help"]):
        ran = beambox(capsys, *words)
        assert ran.status == 0
        assert ran.out.index("Examples:") < ran.out.index("Commands:")
        assert all(f"  {name} " in ran.out for name in COMMANDS)
        assert max(map(len, ran.out.splitlines())) <= 120


def test_every_example_is_of_a_command_that_exists() -> None:
    assert {text.split()[1] for text, _ in EXAMPLES} <= COMMANDS.keys()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_resolves_and_has_help(capsys: pytest.CaptureFixture[str], name: str) -> None:
    command = EntryPoint(name, COMMANDS[name][0], "beambox").load()
    assert isinstance(command, typer.Typer) or command.__doc__
    ran = beambox(capsys, name, "--help")
    assert ran.status == 0 and "Options:" in ran.out and "\x08" not in ran.out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert beambox(capsys, "--version").out == f"beambox {__version__}\n"


def test_an_unknown_command_names_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    ran = beambox(capsys, "detekt", "scan.bin")
    assert (ran.status, ran.out) == (2, "")
    assert ran.err == 'beambox: there is no command "detekt" (did you mean "detect"?); see beambox --help\n'


def test_an_unknown_option_is_a_short_error(capsys: pytest.CaptureFixture[str]) -> None:
    ran = beambox(capsys, "detect", "scan.bin", "--modle", "x")
    assert ran.status == 2 and "--modle" in ran.err and "Traceback" not in ran.err


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (BeamboxError("`x` must be 3,\n got 4"), 2, "beambox: `x` must be 3, got 4\n"),
        (KeyboardInterrupt(), 130, "beambox: interrupted; files already written are whole and stay\n"),
        (OSError(errno.ENOSPC, "No space left on device", "out/a.json"), 2,
         "beambox: out/a.json: No space left on device; free some space or give another folder\n"),
        (PermissionError(errno.EACCES, "Permission denied", "/elsewhere/x"), 2,
         "beambox: /elsewhere/x: Permission denied; give a folder that may be written\n"),
    ],
)  # fmt: skip
def test_what_a_user_can_cause_is_one_line(
    capsys: pytest.CaptureFixture[str], error: BaseException, status: int, line: str
) -> None:
    def command() -> None:
        raise error

    with pytest.raises(SystemExit) as stopped:
        guard(command)()
    assert stopped.value.code == status
    assert capsys.readouterr().err == line


def test_what_a_user_cannot_cause_keeps_its_traceback() -> None:
    def command() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        guard(command)()


def test_errors_without_a_file_are_explained_too() -> None:
    assert explain(OSError("something odd")) == "something odd"
