"""What version 0.1.0 wrote goes on loading: configurations, tensors, checkpoints; recorded before names changed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalogue import CATALOGUE, build, config_from_dict, config_to_dict, tensors_since
from beambox.detectors.renames import FIELDS, current_names
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
    run.restore()
    assert run.step == 2
    saved = part(load_checkpoint(tmp_path / "last.safetensors").tensors, "model.")
    assert all(torch.equal(saved[name], value) for name, value in run.detector.state_dict().items())


def test_tensors_of_checkpoints_are_renamed_in_every_part() -> None:
    tensors = {f"{part}old.0.weight": 1 for part in ("", "model.", "ema.", "optim.")} | {"model.older.0.weight": 2}
    named = current_names(tensors, {"old.0.": "new.first."})
    renamed = {f"{part}new.first.weight" for part in ("", "model.", "ema.", "optim.")}
    assert set(named) == {*renamed, "model.older.0.weight"}


def test_one_thing_has_one_name_and_its_former_one_is_read() -> None:
    for old, new in FIELDS.items():
        plain = {entry.config.__name__: config_to_dict(entry.config()) for entry in CATALOGUE.values()}
        assert all(old not in config for config in plain.values())
        entry = CATALOGUE["pointpillars"]
        assert config_from_dict(entry.config, {old: 17}) == config_from_dict(entry.config, {new: 17})
        with pytest.raises(BeamboxError, match=f"`{old}` is the former name of `{new}`, and both are given"):
            config_from_dict(entry.config, {old: 17, new: 17})
