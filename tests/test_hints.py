"""What people are told to install can be installed: no index holds beambox, and anybody could register the name."""

import pytest

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
