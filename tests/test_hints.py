"""What people are told to install can be installed: no index holds beambox, and anybody could register the name."""

import importlib.util

import pytest

from oracles.command_line import beambox
from oracles.paths import ROOT

ROOMS = ("src", "docs", "examples", "benchmarks", "tests")
FILES = [
    *ROOT.glob("*.md"),
    *(path for room in ROOMS for kind in ("*.py", "*.md", "*.yaml", "*.html") for path in (ROOT / room).rglob(kind)),
]
NAMED = "beambox" + "["


@pytest.mark.parametrize("room", ["", *ROOMS])
def test_no_hint_names_a_package_that_no_index_holds(room: str) -> None:
    places = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in FILES
        if (path.relative_to(ROOT).parts[0] if len(path.relative_to(ROOT).parts) > 1 else "") == room
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if NAMED in line
    ]
    assert not places


@pytest.mark.parametrize(
    "words",
    [
        ("report", "pointpillars-sim", "--data", "."),
        ("explain", "hcnet-kitti", "nowhere.bin"),
    ],
    ids=lambda words: words[0],
)
def test_what_draws_says_what_to_install_before_anything_else(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    """Only the extra `track` happened to bring matplotlib: without it these ended in a traceback."""
    there = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None if name == "matplotlib" else there(name))
    ran = beambox(capsys, *words)
    assert ran.status == 2
    assert "needs the library matplotlib" in ran.err and "[plots]" in ran.err
    assert ran.err.count("\n") == 1
