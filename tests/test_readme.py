"""Documents run: the README's Python, its commands, and every option that any page names."""

from __future__ import annotations

import re
import shlex
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import typer

from beambox.cli.main import COMMANDS
from oracles.command_line import beambox
from oracles.paths import ROOT
from oracles.tiny_detector import street, tiny_weights

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN = ("detect", "show", "doctor", "models")


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language ("" for none)."""
    parts = re.split(r"(?m)^```(\w*)$", page.read_text(encoding="utf-8"))  # text, fence, inside, fence, text, ...
    return [inside for fence, inside in zip(parts[1::4], parts[2::4]) if fence == language]


def commands(page: Path) -> list[list[str]]:
    """Return the words of every `beambox ...` line in a page's blocks."""
    text = "\n".join(block for language in ("", "sh", "bash", "console") for block in blocks(page, language))
    lines = [line.strip().removeprefix("$ ") for line in text.replace("\\\n", " ").splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("beambox ")]


def options_of(name: str) -> set[str]:
    """Return the options a command, or any command below it, knows."""
    command = EntryPoint(name, COMMANDS[name][0], "beambox").load()
    if not isinstance(command, typer.Typer):
        app = typer.Typer()
        app.command()(command)
        command = app
    pending, known = [typer.main.get_command(command)], {"--help"}
    while pending:
        one = pending.pop()
        known |= {option for parameter in one.params for option in (*parameter.opts, *parameter.secondary_opts)}
        pending += list(one.commands.values()) if isinstance(one, typer.core.TyperGroup) else []
    return known


ALL = sorted({(page.name, tuple(words)) for page in PAGES if page.exists() for words in commands(page)})


def test_the_documents_hold_commands() -> None:
    assert len(ALL) > 4


@pytest.mark.parametrize(
    ("page", "words"), ALL, ids=lambda value: " ".join(value)[:60] if isinstance(value, tuple) else ""
)
def test_commands_and_options_that_pages_name_exist(page: str, words: tuple[str, ...]) -> None:
    if words[0] in ("--help", "--version"):
        return
    if words[0] not in COMMANDS:
        pytest.skip(f"{words[0]} has not landed yet")
    used = {word.split("=")[0] for word in words[1:] if re.match(r"--?[a-z]", word)}
    assert used <= options_of(words[0]), f"{page}: {' '.join(words)}"


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in a folder with the sweeps that the README names; every shipped name gives small weights."""
    weights = tiny_weights(tmp_path)

    class Shelf(dict):
        def __contains__(self, name: object) -> bool:
            return True

        def __missing__(self, name: str) -> Path:
            return weights

    monkeypatch.setattr("beambox.infer.predictor.shipped", Shelf)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scans").mkdir()
    for name in ("scan.bin", "scans/a.bin", "scans/b.bin"):
        street().tofile(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("page", ["README.md", "docs/detect.md", "docs/pictures.md"])
def test_python_of_the_documents_runs(desk: Path, capsys: pytest.CaptureFixture[str], page: str) -> None:
    found = blocks(ROOT / page, "python")
    assert found
    for block in found:
        exec(compile(block, page, "exec"), {})
    assert "Car" in capsys.readouterr().out or (desk / "scan.png").exists(), "the examples print or draw something"


README_COMMANDS = [words for words in commands(ROOT / "README.md") if words[0] in RUN and words[0] in COMMANDS]


@pytest.mark.parametrize("words", README_COMMANDS, ids=" ".join)
def test_quick_commands_of_the_readme_run(desk: Path, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    expanded = [str(p) for word in words for p in (sorted(Path().glob(word)) if "*" in word else [word])]
    ran = beambox(capsys, *expanded)
    assert ran.status == 0, ran.err
