"""Documents run: the README's Python, its commands, and every option that any page names."""

from __future__ import annotations

import itertools
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import typer

from beambox.cli.commands import COMMANDS
from beambox.detectors.catalog import CATALOG
from beambox.train.recipes import find_recipe, list_recipes
from beambox.train.tables import TABLES
from beambox.zoo import shipped
from oracles import pages
from oracles.command_line import beambox
from oracles.paths import ROOT
from oracles.tiny_detector import street, tiny_weights

RUN = ("detect", "show", "doctor", "models")
TO_RUN = re.compile(r"^(run\d*|real|sim|M|\S*\.(safetensors|yaml))$|/")  # what a reader trained; a path
NAME = re.compile(r"\b(?:pointpillars|second|voxel_rcnn|hcnet|kassd|dennet)-[a-z0-9_-]*[a-z0-9]\b")


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


COMMAND_LINES = sorted(
    {(block.page, tuple(words[1:])) for block in pages.ALL for words in block.commands if words[0].endswith("beambox")}
)


def test_the_documents_hold_commands() -> None:
    assert len(COMMAND_LINES) > 50


@pytest.mark.parametrize(
    ("page", "words"), COMMAND_LINES, ids=lambda value: " ".join(value)[:60] if isinstance(value, tuple) else ""
)
def test_commands_options_and_names_that_pages_use_exist(page: str, words: tuple[str, ...]) -> None:
    if words[0] in ("--help", "--version"):
        return
    assert words[0] in COMMANDS, f"{page}: there is no command {words[0]}"
    used = {word.split("=")[0] for word in words[1:] if re.match(r"--?[a-z]", word)}
    assert used <= options_of(words[0]), f"{page}: {' '.join(words)}"
    given = dict(itertools.pairwise(words))
    model = given.get("--model") or given.get("-m") or (words[1] if words[0] in ("evaluate", "export", "bench") else "")
    detector = words[0] == "import-openpcdet" or "--config" in words  # not weights
    known = {*CATALOG, *(one.name for one in list_recipes())} if detector else shipped()
    assert not model or model in known or TO_RUN.search(model), f"{page}: no weights are called {model}"
    recipe = given.get("--recipe") or (words[1] if words[0] == "train" else "")
    if recipe and not TO_RUN.search(recipe):
        assert find_recipe(recipe).stem == recipe
    if words[0] == "ablate" and "--table" not in given:  # a file of one's own stands for a name
        assert words[1] in TABLES


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_names_of_weights_recipes_and_tables_in_the_text_exist(page: Path) -> None:
    known = {*shipped(), *TABLES, *(one.name for one in list_recipes())}
    quoted = re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))
    named = {name for text in quoted for name in NAME.findall(text)}
    assert named <= known


@pytest.mark.parametrize("block", [b for b in pages.ALL if b.commands], ids=lambda b: f"{b.page}: {b.text[:40]}")
def test_a_block_of_commands_runs_or_says_why_not(block: pages.Block) -> None:
    """tests/test_wheel.py runs those without a mark, tests/cli/test_own_data.py those marked "run"."""
    assert block.mark in ("", "run") or len(block.why_not.split()) > 2, block.mark


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in a folder with the sweeps that the README names; every shipped name gives small weights."""
    weights = tiny_weights(tmp_path)

    class AnyShipped(dict):
        def __contains__(self, name: object) -> bool:
            return True

        def __missing__(self, name: str) -> Path:
            return weights

    monkeypatch.setattr("beambox.zoo.shipped", AnyShipped)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scans").mkdir()
    for name in ("scan.bin", "scans/a.bin", "scans/b.bin"):
        street().tofile(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize("page", ["README.md", "docs/start.md", "docs/detect.md", "docs/pictures.md"])
def test_python_of_the_documents_runs(desk: Path, capsys: pytest.CaptureFixture[str], page: str) -> None:
    found = [block for block in pages.blocks(ROOT / page) if block.language == "python"]
    assert found
    for block in found:
        exec(compile(block.text, page, "exec"), {})
    assert "Car" in capsys.readouterr().out or (desk / "scan.png").exists(), "the examples print or draw something"


README_COMMANDS = [list(words) for page, words in COMMAND_LINES if page == "README.md" and words[0] in RUN]


@pytest.mark.parametrize("words", README_COMMANDS, ids=" ".join)
def test_quick_commands_of_the_readme_run(desk: Path, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    expanded = [str(p) for word in words for p in (sorted(Path().glob(word)) if "*" in word else [word])]
    ran = beambox(capsys, *expanded)
    assert ran.status == 0, ran.err
