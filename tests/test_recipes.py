"""Every shipped recipe fits the schema, builds its detector, and asks for objects the detector knows."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from beambox.checks import BeamboxError, MissingFileError
from beambox.detectors.catalog import build, tensors_since
from beambox.detectors.weights import read_weights
from beambox.train.config import read_recipe
from beambox.train.recipes import AUDIENCES, find_recipe, list_recipes
from beambox.train.stages import read_stages
from beambox.zoo import shipped

RECIPES = {one.name: one for one in list_recipes()}


ABOUT = {"name", "description", "takes", "ran"}


@pytest.mark.parametrize("name", RECIPES)
def test_recipe_parses_and_builds_its_detector(name: str) -> None:
    about = RECIPES[name]
    for recipe in read_stages(name):
        detector = build(recipe.detector.name, recipe.detector.options)
        classes = detector.config.classes
        assert recipe.name == name
        assert name.startswith(recipe.detector.name + "-")
        assert recipe.description.endswith(".")
        if recipe.augment is not None:
            assert set(recipe.augment.sample) <= set(classes)
        if recipe.validation is not None and recipe.validation.choose_by != "mean":
            assert recipe.validation.choose_by in classes
        if recipe.window is not None:
            assert all(cells <= size for cells, size in zip(recipe.window, detector.config.grid.size))
    assert about.audience in AUDIENCES
    assert about.takes
    assert about.ran.startswith(("yes", "no"))


@pytest.mark.parametrize("name", shipped())
def test_each_shipped_weight_has_a_recipe_of_its_name_and_network(name: str) -> None:
    assert RECIPES[name].audience == "shipped"
    stored = read_weights(shipped()[name])
    last = read_stages(name)[-1]
    built = build(last.detector.name, last.detector.options)
    assert last.detector.name == stored.detector
    own = built.state_dict()
    assert {key: tuple(value.shape) for key, value in tensors_since(built, stored.tensors).items()} == {
        key: tuple(value.shape) for key, value in own.items()
    }
    assert built.config.smooth_l1_beta == stored.config["smooth_l1_beta"]
    steps = sum(stage.optim.iterations or 0 for stage in read_stages(name))
    assert f"{steps:,} steps" in stored.card["training"], "the recipe makes as many steps as the card tells of"


def test_no_shipped_recipe_is_another_with_one_key_changed() -> None:
    def flat(value: object, prefix: str = "") -> dict[str, str]:
        if not isinstance(value, dict):
            return {prefix: repr(value)}
        return {k: v for key, inner in value.items() for k, v in flat(inner, f"{prefix}.{key}").items()}

    plain: dict[str, dict[str, str]] = {}
    for name in RECIPES:
        stages = [one.model_dump(mode="json", exclude=ABOUT) for one in read_stages(name)]
        plain[name] = flat(dict(enumerate(stages)))
    for (a, of_a), (b, of_b) in itertools.combinations(plain.items(), 2):
        differ = [key for key in of_a.keys() | of_b.keys() if of_a.get(key) != of_b.get(key)]
        assert len(differ) > 1, f"{a} and {b} differ in {differ} alone: a documented --set does"


def test_a_recipe_is_found_from_anywhere_and_a_file_still_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_recipe("pointpillars-small").name == "pointpillars-small"
    mine = tmp_path / "mine.yaml"
    mine.write_text(find_recipe("pointpillars-small").read_text(encoding="utf-8"), encoding="utf-8")
    assert read_recipe("mine.yaml") == read_recipe("pointpillars-small")


@pytest.mark.parametrize("wrong", ["pointpilars-sim", "pointpillars_sim", "recipes/pointpillars_sim.yaml"])
def test_a_wrong_or_former_name_is_answered_with_the_nearest(wrong: str) -> None:
    with pytest.raises(MissingFileError, match=r'\(did you mean "pointpillars-sim"\?\); `beambox recipes` lists'):
        find_recipe(wrong)
    with pytest.raises(MissingFileError, match=r"there is no recipe other/place\.yaml; `beambox recipes` lists"):
        find_recipe("other/place.yaml")


def test_stages_change_what_they_name_and_nothing_else() -> None:
    first, second, third, fourth = read_stages("pointpillars-kitti")
    assert [one.optim.iterations for one in (first, second, third, fourth)] == [1500, 2600, 6600, 5500]
    assert [source.objects for source in third.data] == [True, False] and all(one.objects for one in fourth.data)
    assert first.validation is None and second.validation == third.validation is not None
    assert first.augment == second.augment
    assert third.augment is not None and third.augment.translation == (0.0, 0.0, 0.15)
    assert "smooth_l1_beta" not in second.detector.options
    assert third.detector.options == {**second.detector.options, "smooth_l1_beta": 0.04}
    changed = read_stages("pointpillars-kitti", ["optim.iterations=3", "stages.real.optim.lr=0.5"])
    assert [(one.optim.iterations, one.optim.lr) for one in changed] == [(3, 0.003), (3, 0.5), (3, 0.003), (3, 0.003)]


def test_stages_are_refused_where_they_cannot_be() -> None:
    with pytest.raises(BeamboxError, match="pointpillars-kitti has stages; read it by `read_stages`"):
        read_recipe("pointpillars-kitti")
    with pytest.raises(BeamboxError, match="there is no such stage; the stages are simulated, real, heights, longer"):
        read_stages("pointpillars-kitti", ["stages.reel.optim.lr=0.5"])
