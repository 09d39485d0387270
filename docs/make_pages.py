"""Write the pages that are made from what they describe: ``python docs/make_pages.py``.

reference.md from the docstrings of the public API, command_line.md from the commands' own help, models.md from the
cards of the shipped weights, recipes.md from the shipped recipes. A test holds each to its source.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import typer

from beambox.cli.commands import COMMANDS
from beambox.cli.main import EXAMPLES, help_of
from beambox.infer.cards import Card, CardScores, read_card
from beambox.train.recipes import AUDIENCES, list_recipes
from beambox.zoo import shipped

DOCS = Path(__file__).resolve().parent
REFERENCE = runpy.run_path(str(DOCS / "make_reference.py"))
plain: Callable[[str], str] = REFERENCE["plain"]
NOT_RUN = "<!-- not run: help texts; each option is checked to exist, and what pages tell to do runs there -->"


# ---------------------------------------------------------------- command_line.md


def command_line() -> str:
    """Return the page of all commands, from their help."""
    wide = max(len(text) for text, _ in EXAMPLES)
    parts = [
        "# Command line\n",
        "Made from the commands' own help by `python docs/make_pages.py`; `beambox COMMAND --help` prints the same.\n",
        f"{NOT_RUN}\n```\n" + "\n".join(f"{text:<{wide}}  # {what}" for text, what in EXAMPLES) + "\n```\n",
        "| command | what it does |\n|---|---|",
        *(f"| [{name}](#beambox-{name}) | {cell(what)} |" for name, (_, what) in COMMANDS.items()),
        "",
        "Exit status: 0 done, 2 something you can mend (one line on stderr says what), 130 interrupted.\n",
    ]
    for name, command in commands():
        parts += section(name, command)
    return "\n".join(parts).rstrip() + "\n"


def commands() -> Iterator[tuple[str, Any]]:
    """Yield each command as Typer knows it, with its name after `beambox`; groups come before what they hold."""
    for name, (where, _) in COMMANDS.items():
        found = EntryPoint(name, where, "beambox").load()
        if not isinstance(found, typer.Typer):
            app = typer.Typer(add_completion=False, rich_markup_mode=None)
            app.command(name, help=help_of(found))(found)
            found = app
        command = typer.main.get_command(found)
        yield name, command
        if isinstance(command, typer.core.TyperGroup):
            yield from ((f"{name} {word}", one) for word, one in command.commands.items())


def section(name: str, command: Any) -> list[str]:
    """Return the lines of one command: its help, then a table of what it takes."""
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    options = [one for one in command.params if one.param_type_name == "option" and not one.hidden]
    level = "##" if " " not in name else "###"
    lines = [f"{level} beambox {name}\n", *help_lines(command.help or "")]
    rows = [(f"`{place_holder(one)}`", getattr(one, "help", "") or "", "") for one in arguments]
    rows += [(spelled(one), one.help or "", default_of(one)) for one in options if "--help" not in one.opts]
    if rows:
        lines += ["| takes | | default |", "|---|---|---|"]
        lines += [f"| {what} | {cell(text)} | {default} |" for what, text, default in rows]
        lines.append("")
    return lines


def place_holder(argument: Any) -> str:
    """Return how an argument is written in a usage line."""
    name = argument.metavar or argument.name.upper()
    return name if argument.required else f"[{name.strip('[]')}]"


def spelled(option: Any) -> str:
    """Return all spellings of an option, as code."""
    return ", ".join(f"`{word}`" for word in (*option.opts, *option.secondary_opts))


def default_of(option: Any) -> str:
    """Return an option's value where it is not given; empty where that is nothing."""
    value = option.default
    if value in (None, "", False, ()) or callable(value) or type(value).__name__ == "Sentinel":
        return ""
    value = getattr(value, "value", value)
    return f"`{','.join(map(str, value)) if isinstance(value, list | tuple) else value}`"


def help_lines(text: str) -> list[str]:
    """Return a help text as Markdown: the examples in a block."""
    lines: list[str] = []
    for block in text.split("\n\n"):
        words = block.replace("\b\n", "").replace("\b", "")
        if words.strip().startswith("Examples:"):
            examples = [line.strip() for line in words.strip().splitlines()[1:]]
            lines += [f"{NOT_RUN}\n```", *examples, "```\n"]
        elif words.strip():
            lines += [plain(words.strip()), ""]
    return lines


# ---------------------------------------------------------------- models.md


def models() -> str:
    """Return the page of the shipped weights, from their cards."""
    cards = [read_card(path) for path in shipped().values()]
    parts = [
        "# Model zoo\n",
        "The weights that come with beambox, made from their cards by `python docs/make_pages.py`. "
        "`beambox.load(NAME)` loads one, `beambox models NAME` prints its card. How they were trained and chosen: "
        "[trainings.md](trainings.md); the same detectors under one small budget: [comparison.md](comparison.md).\n",
        "| weights | detector | finds | parameters | size | licence |\n|---|---|---|---|---|---|",
        *(
            f"| [{card.name}](#{card.name}) | {card.detector} | {', '.join(card.classes)} | {card.parameters:,} | "
            f"{card.size / 1e6:.1f} MB | {card.licence.split(' (')[0]} |"
            for card in cards
        ),
        "",
    ]
    for card in cards:
        parts += card_section(card)
    return "\n".join(parts).rstrip() + "\n"


def card_section(card: Card) -> list[str]:
    """Return the lines of one card."""
    said = {
        "licence": card.licence,
        "trained on": card.trained_on,
        "training": card.training,
        "recipe": f"`beambox recipes {card.recipe}`" if card.recipe else "",
        "weak at": card.weak_at,
        "sha256": f"`{card.sha256}`",
    }
    lines = [f"## {card.name}\n", f"{card.summary}.\n", "| | |", "|---|---|"]
    lines += [f"| {key} | {cell(value)} |" for key, value in said.items() if value]
    lines.append("")
    if card.scores:
        lines += [f"{card.protocol}:\n", *score_table(card.scores)]
    return lines


def score_table(sets: tuple[CardScores, ...]) -> list[str]:
    """Return a table of scores, a row for each data set, and the commands that repeat them."""
    metrics = list(dict.fromkeys(metric for one in sets for metric in one.values))
    lines = [f"| scored | {' | '.join(metrics)} |", f"|---|{'---|' * len(metrics)}"]
    lines += [f"| {one.data} | {' | '.join(one.values.get(metric, '') for metric in metrics)} |" for one in sets]
    lines.append("")
    commands = list(dict.fromkeys(one.command for one in sets if one.command))
    notes = list(dict.fromkeys(one.note for one in sets if one.note))
    if commands:
        lines += ["<!-- not run: it needs KITTI's scans -->", "```", *commands, "```", ""]
    lines += [f"{note[:1].upper()}{note[1:]}.\n" for note in notes]
    return lines


# ---------------------------------------------------------------- recipes.md


def recipes() -> str:
    """Return the page of the shipped recipes."""
    parts = [
        "# Recipes\n",
        "What `beambox train NAME --data DIR` takes, made from the files by `python docs/make_pages.py`; "
        "`beambox recipes NAME > mine.yaml` begins one of your own. Every key: [training.md](training.md).\n",
    ]
    found = list_recipes()
    for audience, purpose in AUDIENCES.items():
        parts += [f"## {audience}\n", f"To {purpose}.\n" if audience != "research" else f"The {purpose}.\n"]
        parts += ["| recipe | what comes out | takes | ran |", "|---|---|---|---|"]
        for one in found:
            if one.audience == audience:
                stages = f" Stages: {', '.join(one.stages)}." if one.stages else ""
                parts.append(
                    f"| `{one.name}` | {cell(one.description + stages)} | {cell(one.takes)} | {cell(one.ran)} |"
                )
        parts.append("")
    return "\n".join(parts).rstrip() + "\n"


# ----------------------------------------------------------------


def cell(text: str) -> str:
    """Return text for a cell of a table."""
    return plain(" ".join(text.split())).replace("|", "\\|")


PAGES: dict[str, Callable[[], str]] = {
    "reference.md": REFERENCE["page"],
    "command_line.md": command_line,
    "models.md": models,
    "recipes.md": recipes,
}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (DOCS / name).write_text(page(), encoding="utf-8")
