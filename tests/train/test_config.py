"""Recipes: what is accepted, what is refused, and in which words."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from beambox.checks import BeamboxError, MissingFileError
from beambox.train.config import Recipe, apply_overrides, parse_recipe, read_recipe

PLAIN = {
    "name": "x",
    "detector": {"name": "pointpillars"},
    "data": [{"kind": "kitti"}],
    "optim": {"epochs": 2},
}


def changed(**overrides: object) -> Recipe:
    return parse_recipe(
        apply_overrides(PLAIN, [f"{key.replace('__', '.')}={value}" for key, value in overrides.items()])
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({**PLAIN, "detecter": 1}, r'recipe: unknown key "detecter" \(did you mean "detector"\?\)'),
        ({**PLAIN, "optim": {"epochs": 1, "lrr": 1}}, r'recipe: optim: unknown key "lrr" \(did you mean "lr"\?\)'),
        ({**PLAIN, "optim": {}}, "optim: give either `epochs` or `iterations`"),
        ({**PLAIN, "optim": {"epochs": 1, "iterations": 1}}, "give either"),
        ({**PLAIN, "optim": {"epochs": 1, "lr": -1}}, "optim.lr: input should be greater than 0, got -1"),
        ({**PLAIN, "window": [100, 96]}, r"window: must be positive multiples of 8 cells, got \[100, 96\]"),
        ({**PLAIN, "data": []}, "data: "),
        ({**PLAIN, "data": [{"kind": "kity"}]}, "data.0.kind: input should be 'kitti'"),
        ({**PLAIN, "data": [{"kind": "kitti"}, {"kind": "kitti", "weight": 1}]}, "every source a `weight`, or none"),
        ({k: v for k, v in PLAIN.items() if k != "optim"}, "optim: field required"),
    ],
)
def test_faults_are_named_with_their_place(values: dict[str, object], message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        parse_recipe(values)


def test_overrides_reach_nested_values_and_lists() -> None:
    recipe = changed(optim__lr="1e-3", data__0__split="trainval", detector__options__max_points=8, ema="null")
    assert recipe.optim.lr == 1e-3
    assert recipe.data[0].split == "trainval"
    assert recipe.detector.options == {"max_points": 8}
    assert recipe.ema is None


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("optim.lr", r"`--set` takes key=value"),
        ("data.1.split=val", r'"1" must be a position from 0 to 0'),
        ("name.x=1", r'"name" holds a value, not a section'),
        ("optim.clip=[", r"not valid YAML"),
    ],
)
def test_broken_overrides_are_refused(override: str, message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        apply_overrides(PLAIN, [override])


def test_overrides_leave_the_original_alone() -> None:
    apply_overrides(PLAIN, ["data.0.split=val", "optim.epochs=7"])
    assert PLAIN["data"] == [{"kind": "kitti"}]
    assert PLAIN["optim"] == {"epochs": 2}


def test_recipe_survives_a_round_trip_through_plain_values() -> None:
    recipe = changed(window="[64, 64]")
    assert parse_recipe(yaml.safe_load(yaml.safe_dump(recipe.model_dump(mode="json")))) == recipe


def test_missing_and_malformed_files(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="there is no recipe"):
        read_recipe(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1")
    with pytest.raises(BeamboxError, match="not valid YAML"):
        read_recipe(tmp_path / "bad.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(BeamboxError, match="must be a mapping"):
        read_recipe(tmp_path / "list.yaml")


def test_every_field_is_documented() -> None:
    def walk(model: type) -> None:
        for name, field in model.model_fields.items():
            assert field.description or name not in model.__annotations__, (
                f"{model.__name__}.{name} says nothing of itself"
            )

    from beambox.train import config

    for name in config.__all__:
        member = getattr(config, name)
        if isinstance(member, type):
            walk(member)


def test_augmentation_keys_are_those_of_the_data_package() -> None:
    values = {**PLAIN, "augment": {"flip_x": 0.5, "rotatoin": 1.0}}
    with pytest.raises(BeamboxError, match=r'augment: unknown key "rotatoin" \(did you mean "rotation"\?\)'):
        parse_recipe(values)
    assert parse_recipe({**PLAIN, "augment": {"sample": {"Car": 3}}}).augment is not None
