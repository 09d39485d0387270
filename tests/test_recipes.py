"""Every shipped recipe fits the schema, builds its detector, and asks for objects the detector knows."""

from __future__ import annotations

from pathlib import Path

import pytest

from beambox.detectors.catalogue import build
from beambox.train.config import read_recipe

RECIPES = sorted((Path(__file__).resolve().parents[1] / "recipes").glob("*.yaml"))


def test_there_are_recipes() -> None:
    assert len(RECIPES) >= 3


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_recipe_parses_and_builds_its_detector(path: Path) -> None:
    recipe = read_recipe(path)
    detector = build(recipe.detector.name, recipe.detector.options)
    classes = detector.config.classes
    assert recipe.name.replace("-", "_") == path.stem.replace("-", "_")
    assert recipe.description.endswith(".")
    if recipe.augment is not None:
        assert set(recipe.augment.sample) <= set(classes)
    if recipe.validation is not None and recipe.validation.choose_by != "mean":
        assert recipe.validation.choose_by in classes
    if recipe.window is not None:
        assert all(cells <= size for cells, size in zip(recipe.window, detector.config.grid.size))
