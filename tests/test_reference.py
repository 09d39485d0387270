"""The reference page is what the docstrings say, and says something of every public name."""

from __future__ import annotations

import runpy
from pathlib import Path

import beambox

DOCS = Path(__file__).resolve().parents[1] / "docs"


def test_the_page_is_up_to_date() -> None:
    generated = runpy.run_path(str(DOCS / "make_reference.py"))["page"]()
    there = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert generated == there, "run: python docs/make_reference.py"
    assert all(f"### {name}\n" in generated for name in beambox.__all__)
