"""The shipped recipes, found by name from anywhere: ``find_recipe("pointpillars-kitti")``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from beambox.checks import MissingFileError, did_you_mean
from beambox.io import read_yaml

__all__ = ["AUDIENCES", "ShippedRecipe", "find_recipe", "list_recipes", "recipe_files"]

FOLDER = Path(__file__).resolve().parents[1] / "recipes"

AUDIENCES = {
    "shipped": "make the shipped weights again",
    "published": "repeat a publication, on a GPU",
    "cpu": "try things on a CPU",
    "research": "small trainings behind the tables of ablations and comparisons",
}
"""Folder of the recipes -> whom they are for."""


@dataclass(frozen=True)
class ShippedRecipe:
    """One recipe of the package, as a list shows it."""

    name: str
    """By which it is found."""
    audience: str
    """A key of :data:`AUDIENCES`."""
    path: Path
    """Its file."""
    description: str
    """What comes out."""
    takes: str
    """How long it takes, and on what."""
    ran: str
    """Whether it was ever run to the end, and where the result stands."""
    stages: tuple[str, ...]
    """Names of its stages, each of which begins with the weights of the one before; empty where it has none."""


def recipe_files() -> dict[str, Path]:
    """Return the file of each shipped recipe, by name, in the order of :data:`AUDIENCES`."""
    return {path.stem: path for audience in AUDIENCES for path in sorted((FOLDER / audience).glob("*.yaml"))}


def list_recipes() -> list[ShippedRecipe]:
    """Read what each shipped recipe says of itself, in the order of :data:`AUDIENCES`."""
    found = []
    for name, path in recipe_files().items():
        values = read_yaml(path)
        stages = tuple(values.get("stages") or ())
        texts = (values["description"], values["takes"], values["ran"])
        found.append(ShippedRecipe(name, path.parent.name, path, *texts, stages))
    return found


def find_recipe(name: str | Path) -> Path:
    """Find a recipe: the name of a shipped one, or a path.

    Raises:
        MissingFileError: naming the nearest shipped one, with the spelling of its old file (``recipes/x_y.yaml``) too.
    """
    path = Path(name)
    if path.is_file():
        return path
    files = recipe_files()
    if str(name) in files:
        return files[str(name)]
    if len(path.parts) > 1 and path.parts[-2] != "recipes":
        raise MissingFileError(f"there is no recipe {path}; `beambox recipes` lists the shipped ones")
    word = path.name.removesuffix(".yaml")
    alike = {known.replace("_", "-"): known for known in files}
    same = alike.get(word.replace("_", "-"))
    near = did_you_mean(word, files)
    hint = f' (did you mean "{same}"?)' if same else near if near.startswith(" (did") else ""  # the list is long
    raise MissingFileError(
        f'no recipe is called "{name}" and no such file is there{hint}; `beambox recipes` lists the shipped ones'
    )
