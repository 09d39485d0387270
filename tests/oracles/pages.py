"""The fenced blocks of the README and the docs, and the commands in them."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from oracles.paths import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("", "sh", "bash", "console")
PROGRAMS = ("beambox", "python", "python3", "pip", "make", "torchrun", "git", ".venv/bin/beambox")
BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>[^\n]*) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    page: str
    """Name of the file."""
    language: str
    """As its fence says; empty for none."""
    text: str
    """What it holds."""
    mark: str
    """The comment on the line before it, as ``not run: it takes a GPU``; empty for none."""

    @property
    def commands(self) -> list[list[str]]:
        """The words of each line that calls a program, without comments."""
        if self.language not in SHELL:
            return []
        lines = [line.strip().removeprefix("$ ") for line in self.text.replace("\\\n", " ").splitlines()]
        return [shlex.split(line, comments=True) for line in lines if line.split(" ")[0] in PROGRAMS]

    @property
    def why_not(self) -> str:
        """Why it is not run; empty where it is."""
        return self.mark.removeprefix("not run:").strip() if self.mark.startswith("not run:") else ""


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [Block(page.name, m["language"], m["text"], m["mark"] or "") for m in BLOCK.finditer(text)]


ALL = [block for page in PAGES for block in blocks(page)]
