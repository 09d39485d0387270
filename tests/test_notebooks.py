"""The notebooks run from top to bottom, and are kept clean."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from oracles.paths import ROOT

NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def cells(path: Path) -> list[dict[str, object]]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def test_there_are_three() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["first_detection", "new_module", "own_data"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path: Path) -> None:
    book = json.loads(path.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in book["cells"]}) == len(book["cells"])
    for cell in book["cells"]:
        assert cell["cell_type"] == "markdown" or (cell["outputs"] == [] and cell["execution_count"] is None)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path: Path, tmp_path: Path) -> None:
    """As a script, in an empty folder: the cells hold plain Python, without magics."""
    code = ["".join(cell["source"]) for cell in cells(path) if cell["cell_type"] == "code"]  # pyright: ignore
    (tmp_path / "notebook.py").write_text("\n\n".join(code), encoding="utf-8")
    words = [sys.executable, "-W", "error::DeprecationWarning:__main__", "notebook.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    assert "Car" in done.stdout, "it ends in scores"
