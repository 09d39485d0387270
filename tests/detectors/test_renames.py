"""What version 0.1.0 wrote goes on loading: configurations, tensors, checkpoints; recorded before names changed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import CATALOG, build, config_from_dict, config_to_dict, tensors_since
from beambox.detectors.renames import FIELDS, current_fields, current_names
from beambox.detectors.weights import fill
from beambox.train.checkpoint import load_checkpoint, part
from oracles.small_detectors import VARIANTS
from oracles.tiny_training import tiny_run

FIXTURES = Path(__file__).resolve().parents[1] / "fixtures"
RECORDED: dict[str, Any] = json.loads((FIXTURES / "detectors_0.1.0.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("variant", RECORDED)
def test_configurations_and_tensors_of_0_1_0_fit(variant: str) -> None:
    recorded = RECORDED[variant]
    model = build(recorded["detector"], recorded["config"])
    assert model.config == VARIANTS[variant]
    stored = {
        name: torch.randn(shape, generator=torch.Generator().manual_seed(number))
        for number, (name, shape) in enumerate(recorded["tensors"].items())
    }
    counters = {name: value for name, value in model.state_dict().items() if name.endswith("num_batches_tracked")}
    now = tensors_since(model, stored)
    assert len(now) == len(stored)
    with torch.no_grad():
        fill(model, {**stored, **counters}, "the recording")
    state = model.state_dict()
    assert all(torch.equal(state[name], value) for name, value in now.items())
    assert sorted(map(str, now.values())) == sorted(map(str, stored.values()))


def test_a_checkpoint_of_0_1_0_resumes(tmp_path: Path) -> None:
    shutil.copy(FIXTURES / "checkpoint_0.1.0.safetensors", tmp_path / "last.safetensors")
    run = tiny_run(tmp_path)
    assert "detector" not in run.restore(), "former names of options are no change of the recipe"
    assert run.step == 2
    saved = part(load_checkpoint(tmp_path / "last.safetensors").tensors, "model.")
    assert all(torch.equal(saved[name], value) for name, value in run.detector.state_dict().items())


def test_tensors_of_checkpoints_are_renamed_in_every_part() -> None:
    tensors = {f"{part}old.0.weight": 1 for part in ("", "model.", "ema.", "optim.")} | {"model.older.0.weight": 2}
    named = current_names(tensors, {"old.0.": "new.first."})
    renamed = {f"{part}new.first.weight" for part in ("", "model.", "ema.", "optim.")}
    assert set(named) == {*renamed, "model.older.0.weight"}


def given(path: str, value: object) -> dict[str, Any]:
    """Return options with one field of a section, a list of sections or the top."""
    *sections, name = path.split(".")
    section = sections[0] if sections else ""
    if section in ("anchors", "pooling"):
        return {section: [{name: value}]}
    return {section: {name: value}} if section else {name: value}


@pytest.mark.parametrize("old", FIELDS)
def test_every_former_name_is_read_as_the_present_one(old: str) -> None:
    new = ".".join((*old.split(".")[:-1], FIELDS[old]))
    owners = [entry for entry in CATALOG.values() if has(config_to_dict(entry.config()), new)]
    assert owners, f"no detector has a field {new}"
    for entry in CATALOG.values():
        assert not has(config_to_dict(entry.config()), old)
    for entry in owners:
        own = config_to_dict(entry.config())
        assert current_fields(given(old, 17), own) == given(new, 17)
        both = given(old, 17)
        target = both
        for section in old.split(".")[:-1]:
            target = both[section][0] if isinstance(both[section], list) else both[section]
        target[FIELDS[old]] = 17
        with pytest.raises(BeamboxError, match=f"`{old}` is the former name of `{new}`, and both are given"):
            config_from_dict(entry.config, both)


def has(config: dict[str, Any], path: str) -> bool:
    """Return whether a configuration has a field, in a section or the first of a list of sections."""
    value: Any = config
    for part_of_path in path.split("."):
        value = value[0] if isinstance(value, list) and value else value
        if not isinstance(value, dict) or part_of_path not in value:
            return False
        value = value[part_of_path]
    return True


def test_a_detector_from_outside_may_have_a_field_of_a_former_name() -> None:
    own = {"columns": 3, "sampling": {"score_low": 0.1}, "anchors": []}
    options = {"columns": 5, "sampling": {"score_low": 0.2, "score_high": 0.9}, "anchors": [{"bottom": 1.0}]}
    expected = {"columns": 5, "sampling": {"score_low": 0.2, "cls_fg_iou": 0.9}, "anchors": [{"bottom_z": 1.0}]}
    assert current_fields(options, own) == expected
