"""The page for people from other toolboxes: each key of ours that it names exists, and so does each command."""

from __future__ import annotations

import re

import pytest

from beambox.cli.commands import COMMANDS
from beambox.detectors.catalog import CATALOG, config_to_dict
from beambox.train.config import Recipe
from oracles.paths import ROOT

PAGE = (ROOT / "docs" / "coming_from.md").read_text(encoding="utf-8")
FULL = Recipe.model_validate(
    {
        "name": "full",
        "detector": {"name": "pointpillars"},
        "data": [{"kind": "kitti"}],
        "augment": {},
        "optim": {"iterations": 1},
        "validation": {"source": {"kind": "kitti"}},
    }
).model_dump(mode="json")
OPTIONS = {name: config_to_dict(entry.config()) for name, entry in CATALOG.items()}


def column(title: str, position: int) -> list[str]:
    """Return what stands as code in one column of the tables below a heading."""
    (part,) = re.findall(rf"(?ms)^## {title}\n(.*?)(?=^## |\Z)", PAGE)
    rows = [line.strip("|").split("|") for line in part.splitlines() if line.startswith("|")][2:]
    return [key for row in rows for key in re.findall(r"`([^`]+)`", row[position])]


def holds(values: object, key: str) -> bool:
    """Return whether a path such as ``data.0.split`` leads somewhere."""
    for word in key.split("."):
        if isinstance(values, list):
            values = dict(enumerate(values)).get(int(word))
        elif isinstance(values, dict) and word in values:
            values = values[word]
        else:
            return False
    return True


RECIPE_KEYS = column("Data and training", 2)
OPTION_KEYS = column("Networks", 3)


def test_the_tables_are_read() -> None:
    assert len(RECIPE_KEYS) > 20 and len(OPTION_KEYS) > 25
    assert not holds(FULL, "optim.momentum") and not holds(OPTIONS["second"], "anchors.0.align_center")


@pytest.mark.parametrize("key", RECIPE_KEYS)
def test_keys_of_recipes_exist(key: str) -> None:
    assert holds(FULL, key)


@pytest.mark.parametrize("key", OPTION_KEYS)
def test_keys_of_detectors_exist(key: str) -> None:
    rooms = [key] if key in ("voxel_channels",) else []
    known = {name for name, options in OPTIONS.items() if holds(options, key)}
    assert known, f"no detector has {key}"
    special = rooms or re.search(rf"`{re.escape(key)}`[^|]*\|[^|]*Voxel R-CNN", PAGE)
    assert special or {"pointpillars", "second", "voxel_rcnn"} <= known


def test_commands_exist() -> None:
    named = [words.split() for words in re.findall(r"`(beambox [^`]+)`", PAGE)]
    assert len(named) > 8
    assert all(words[1] in COMMANDS for words in named)
