"""The site: each page is in the navigation, links and anchors lead somewhere, made pages are current, it builds."""

from __future__ import annotations

import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from oracles.pages import PAGES
from oracles.paths import ROOT

DOCS = ROOT / "docs"
MADE = runpy.run_path(str(DOCS / "make_pages.py"))["PAGES"]
SITE = runpy.run_path(str(DOCS / "make_site.py"))


def slug(title: str) -> str:
    """Return the anchor of a heading, as Python-Markdown (the site) and forges make it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", lambda m: m[1] or "", title).replace("\\", "")
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    text = "".join(part for code, part in SITE["split_code"](page.read_text(encoding="utf-8")) if not code)
    return {slug(title) for title in re.findall(r"(?m)^#{1,6} (.+)$", text)}


def navigation() -> list[str]:
    """Return the pages of the navigation, read without a library: tomllib is not there in Python 3.10."""
    text = (ROOT / "zensical.toml").read_text(encoding="utf-8")
    return re.findall(r'"([^"]+\.md)"', text)


def test_each_page_is_once_in_the_navigation() -> None:
    named = navigation()
    assert len(named) == len(set(named))
    inside = {name for name in named if not name.startswith("files/")}
    assert inside == {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert all((ROOT / name.removeprefix("files/")).is_file() for name in set(named) - inside)


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CHANGELOG.md", ROOT / "benchmarks" / "README.md"], ids=lambda p: p.name
)
def test_links_and_anchors_lead_somewhere(page: Path) -> None:
    for path, anchor in SITE["links_of"](page):
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name}: {path} is not there"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {path} has no heading #{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_pages_read_alike_in_a_checkout_and_on_the_site(page: Path) -> None:
    """Python-Markdown wants an empty line before a list, and four spaces before what belongs to an item."""
    before = ""
    for code, part in SITE["split_code"](page.read_text(encoding="utf-8")):
        if code:
            assert not re.match(r" {1,3}```", part), f"{page.name}: a block in a list is indented by four spaces"
            before = ""
            continue
        for line in part.splitlines():
            item = re.match(r"( *)([*-]|\d+\.) ", line)
            goes_on = before.startswith(" ") or re.match(r" *([*-]|\d+\.) ", before)
            assert not item or not before.strip() or goes_on, f"{page.name}: an empty line before the list: {line}"
            assert not item or len(item[1]) % 4 == 0, f"{page.name}: four spaces: {line}"
            before = line


@pytest.mark.parametrize("name", sorted(set(MADE) - {"reference.md"}))  # tests/test_reference.py
def test_pages_made_from_the_code_are_up_to_date(name: str) -> None:
    assert MADE[name]() == (DOCS / name).read_text(encoding="utf-8"), "run: python docs/make_pages.py"


def test_a_page_with_a_broken_link_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "index.md").write_text("# One\n\n[to](../there.py) and [nowhere](gone.md)\n")
    (tmp_path / "there.py").write_text("x = 1\n")
    (tmp_path / "zensical.toml").write_text("")
    monkeypatch.setitem(SITE["stage"].__globals__, "ROOT", tmp_path)
    monkeypatch.setitem(SITE["stage"].__globals__, "DOCS", docs)
    with pytest.raises(SystemExit, match=r"docs/index.md: no such file: gone.md"):
        SITE["stage"](tmp_path / "out")
    (docs / "index.md").write_text("# One\n\n[to](../there.py)\n")
    SITE["stage"](tmp_path / "out")
    assert "[to](files/there.py.md)" in (tmp_path / "out" / "index.md").read_text()
    assert "x = 1" in (tmp_path / "out" / "files" / "there.py.md").read_text()


@pytest.mark.skipif(importlib.util.find_spec("zensical") is None, reason="needs the extra docs")
def test_the_site_builds_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    words = [sys.executable, "docs/make_site.py", str(tmp_path / "site")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert (tmp_path / "site" / "hcnet.html").is_file()
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        (here,) = re.findall(r'src="([^"]*worker_here\.js)"', text)
        assert (page.parent / here).is_file(), "search works from the file system"
        assert not re.findall(r'<(?:script|img)[^>]*src="https?:|<link[^>]*stylesheet[^>]*href="https?:', text), page
