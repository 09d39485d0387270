"""Build the site from the checkout, offline: ``python make.py docs``, or ``python docs/make_site.py OUT``.

The pages of ``docs/`` are read by people in a checkout too, so they link to files outside ``docs/``. Here such files
get pages of their own: Markdown as it is, everything else as a listing. Zensical then builds the site and refuses
broken links; what it does not look at, this file refuses.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
CONFIG = "zensical.toml"
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)|(!\[[^\]]*\]\()([^)\s]+)\)")
LISTED = {".py": "python", ".yaml": "yaml", ".toml": "toml", ".ipynb": "json", ".sbatch": "bash", "": "text"}
"""Endings of the files outside ``docs/`` that may be linked to -> language of their listing."""


def split_code(text: str) -> list[tuple[bool, str]]:
    """Part a page into (is it a fenced block, text), in order."""
    parts = re.split(r"(?ms)(^ *```.*?^ *```$)", text)
    return [(number % 2 == 1, part) for number, part in enumerate(parts)]


def links_of(page: Path) -> list[tuple[str, str]]:
    """Return (path, anchor) of each link of a page that stays in the checkout, code left out."""
    text = "".join(part for code, part in split_code(page.read_text(encoding="utf-8")) if not code)
    text = re.sub(r"`[^`\n]*`", "``", text)
    pairs = re.findall(r"\]\(([^)\s#]*)(#[^)\s]*)?\)", text)
    return [(path, anchor.removeprefix("#")) for path, anchor in pairs if "://" not in path]


def place_of(file: Path) -> PurePosixPath:
    """Return where a file of the checkout lies on the site, as a page or, below ``docs/``, as itself."""
    if file.is_relative_to(DOCS):
        return PurePosixPath(file.relative_to(DOCS).as_posix())
    inside = PurePosixPath(file.relative_to(ROOT).as_posix())
    return "files" / (inside if inside.suffix == ".md" else inside.with_name(inside.name + ".md"))


def title_of(page: Path) -> str:
    """Return the first heading of a page."""
    return re.findall(r"(?m)^# (.+)$", page.read_text(encoding="utf-8"))[0]


def listing(file: Path) -> str:
    """Return a page that shows a file outside ``docs/``."""
    text = file.read_text(encoding="utf-8")
    return f"# {file.relative_to(ROOT).as_posix()}\n\n````{LISTED[file.suffix]}\n{text}````\n"


def stage(target: Path) -> None:
    """Write every page, picture and linked file below ``target`` with links that fit there.

    Raises:
        SystemExit: naming each link that leads nowhere.
    """
    waiting = [path for path in sorted(DOCS.rglob("*")) if path.is_file() and path.suffix != ".py"]
    waiting += [ROOT / name for name in re.findall(r'"files/([^"]+)"', (ROOT / CONFIG).read_text(encoding="utf-8"))]
    done: set[Path] = set()
    broken: list[str] = []
    while waiting:
        file = waiting.pop()
        if file in done:
            continue
        done.add(file)
        out = target / place_of(file)
        out.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".md":
            text, linked, missing = with_links(file)
            out.write_text(text, encoding="utf-8")
            waiting += linked
            broken += missing
        elif file.is_relative_to(DOCS):
            shutil.copyfile(file, out)
        else:
            out.write_text(listing(file), encoding="utf-8")
    if broken:
        raise SystemExit("\n".join(broken))


def with_links(file: Path) -> tuple[str, list[Path], list[str]]:
    """Return a page's text with links between places on the site, the files outside docs/ it names, broken links."""
    linked: list[Path] = []
    broken: list[str] = []

    def moved(match: re.Match[str]) -> str:
        text, path, anchor, picture, source = match.groups()
        path = path or source
        if "://" in path or path.startswith("mailto:"):
            return match[0]
        to = Path(os.path.normpath(file.parent / path))
        if not to.is_file() or not to.is_relative_to(ROOT):
            broken.append(f"{file.relative_to(ROOT)}: no such file: {path}")
            return match[0]
        if not to.is_relative_to(DOCS):
            linked.append(to)
        start = str(place_of(file).parent)
        where = Path(os.path.relpath(place_of(to), start)).as_posix()
        if picture:
            return f"{picture}{where})"
        if text == path and to.suffix == ".md":  # in a checkout the file's name helps, here its title
            text = title_of(to)
        return f"[{text}]({where}{anchor or ''})"

    parts = split_code(file.read_text(encoding="utf-8"))
    return "".join(part if code else LINK.sub(moved, part) for code, part in parts), linked, broken


def build(out: Path) -> None:
    """Build the site into a folder.

    Raises:
        SystemExit: if a link is broken, or Zensical warns or is not there.
    """
    if importlib.util.find_spec("zensical") is None:
        raise SystemExit('the site needs Zensical and Python 3.11 or later: python -m pip install ".[docs]"')
    work = ROOT / "build" / "site"
    shutil.rmtree(work, ignore_errors=True)
    stage(work / "docs")
    shutil.copyfile(ROOT / CONFIG, work / CONFIG)
    words = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    status = subprocess.run(words, cwd=work, check=False).returncode
    if status:
        raise SystemExit(status)
    keep_search_here(work / "site")
    shutil.rmtree(out, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(work / "site", out)
    print(f"the site: {out / 'index.html'}")


def keep_search_here(site: Path) -> None:
    """Let the search work from the file system without what the offline plugin would fetch from elsewhere.

    A browser starts no worker from a file, but does so from text: the worker's text comes with the page.
    """
    scripts = site / "assets" / "javascripts"
    (worker,) = (scripts / "workers").glob("*.js")
    (scripts / "worker_here.js").write_text(
        f"const workerText = {json.dumps(worker.read_text(encoding='utf-8'))};\n"
        "if (location.protocol === 'file:') window.Worker = class extends Worker {\n"
        "  constructor() { super(URL.createObjectURL(new Blob([workerText], {type: 'text/javascript'}))); }\n"
        "};\n",
        encoding="utf-8",
    )
    for page in site.rglob("*.html"):
        above = "../" * (len(page.relative_to(site).parts) - 1)
        here = f'<script src="{above}assets/javascripts/worker_here.js"></script>'
        text = re.sub(r'<script src="https://.*?</script>', here, page.read_text(encoding="utf-8"))
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT / "site")
