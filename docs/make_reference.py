"""Write docs/reference.md from the docstrings of the public API: ``python docs/make_reference.py``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import beambox
from beambox import verbs

PAGE = Path(__file__).with_name("reference.md")
HEAD = """# Reference

The public API, made from its docstrings by `python docs/make_reference.py`; a test holds the two together. Every name
is an attribute of `beambox` and loaded on first use. Boxes are x y z l w h yaw in the LiDAR frame, metres and radians
([conventions.md](conventions.md)).
"""
WIDTH = 100
"""Columns beyond which a signature is spread over lines."""
GROUPS = {
    "Functions": inspect.isfunction,
    "Classes": inspect.isclass,
}


def public() -> dict[str, object]:
    """Return what each public name stands for; a package that can be called stands for its verb."""
    found = {}
    for name in beambox.__all__:
        thing = getattr(beambox, name)
        found[name] = getattr(verbs, name) if inspect.ismodule(thing) else thing
    return found


def page() -> str:
    """Return the whole page."""
    things = public()
    parts = [HEAD]
    for title, belongs in GROUPS.items():
        parts.append(f"## {title}\n")
        for name, thing in things.items():
            if belongs(thing):
                parts.append(entry(name, thing, "###"))
    return "\n".join(parts)


def entry(name: str, thing: object, level: str) -> str:
    """Return the section of one name: how it is called, its docstring, and what a class holds."""
    lines = [f"{level} {name}\n", "```text", f"{name}{spread(signature(thing))}", "```\n", *described(text(thing))]
    if inspect.isclass(thing):
        lines += [row for member in members(thing) for row in member]
    return "\n".join(lines)


def spread(shown: str) -> str:
    """Put the parameters of a long signature on lines of their own."""
    if len(shown) < WIDTH:
        return shown
    inside, _, after = shown[1:].rpartition(")")
    depth, parts = 0, [""]
    for letter in inside:
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return "(\n" + "".join(f"    {part.strip()},\n" for part in parts) + ")" + after


def described(docstring: str) -> list[str]:
    """Return a docstring as Markdown: its sections (Args, Returns, Raises, ...) as lists, code as it stands."""
    lines: list[str] = []
    section = ""
    for line in docstring.splitlines():
        head = re.fullmatch(r"(Args|Returns|Yields|Raises|Attributes):", line)
        if head:
            section = head[1]
            lines += [f"**{section}**\n"]
        elif not section:
            lines.append(plain(line))
        elif not line.strip():
            lines.append("")
            section = section if section in ("Args", "Raises") else ""
        elif re.match(r" {4}\S", line) and section in ("Args", "Raises", "Attributes"):
            word, colon, rest = line.strip().partition(": ")
            lines.append(f"* `{word}`: {plain(rest)}" if colon else f"* {plain(word)}")
        else:
            lines.append(("  " if section in ("Args", "Raises", "Attributes") else "") + plain(line.strip()))
    return [*lines, ""]


def plain(line: str) -> str:
    """Return a line in which Markdown finds nothing to mark outside of code."""
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(part if part.startswith("`") else re.sub(r"([<>*_\[\]])", r"\\\1", part) for part in parts)


def members(kind: type) -> Iterator[list[str]]:
    """Yield a line for each public method and property of a class, in the order of its source."""
    rows = []
    for name, member in vars(kind).items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if (name.startswith("_") and name != "__call__") or not inspect.isfunction(function):
            continue
        what = name if isinstance(member, property) else f"{name}{signature(function, drop_self=True)}"
        first = text(function).partition("\n")[0]
        rows.append(f"| `{what}` | {first} |".replace(" | ", " \\| ").replace("` \\| ", "` | ", 1))
    if rows:
        yield ["| of it | |", "|---|---|", *rows, ""]


def signature(thing: object, drop_self: bool = False) -> str:
    """Return how a function or a class is called."""
    try:
        found = inspect.signature(thing)
    except (TypeError, ValueError):
        return ""
    parameters = list(found.parameters.values())
    if drop_self and parameters and parameters[0].name in ("self", "cls"):
        parameters = parameters[1:]
    parameters = [one.replace(annotation=_Plain(one.annotation)) for one in parameters]
    shown = str(found.replace(parameters=parameters, return_annotation=_Plain(found.return_annotation)))
    return re.sub(r"<factory>|<function .*?>", "...", shown)


class _Plain:
    """An annotation that is shown as it stands in the source, without quotes."""

    def __new__(cls, annotation: object) -> object:
        return super().__new__(cls) if isinstance(annotation, str) else annotation

    def __init__(self, annotation: str) -> None:
        self.annotation = annotation

    def __repr__(self) -> str:
        return self.annotation


def text(thing: object) -> str:
    """Return a docstring without its markup."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", inspect.getdoc(thing) or "").replace("``", "`")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
