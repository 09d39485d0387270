"""Training from other weights: shipped names, other classes, and what fits is taken and the rest is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build
from beambox.detectors.weights import read_weights, save_weights
from beambox.train.config import DetectorSection
from beambox.train.start import build_detector
from beambox.zoo import shipped
from oracles.tiny_training import OPTIONS

FORKLIFT = {
    "name": "Forklift",
    "size": [3.0, 1.5, 2.0],
    "bottom_z": -1.73,
    "matched_threshold": 0.5,
    "unmatched_threshold": 0.35,
}


def start(weights: object, **options: Any) -> tuple[Any, list[str]]:
    section = DetectorSection(name="pointpillars", options=options, start_from=str(weights))
    return build_detector(section, seed=0)


def test_a_shipped_name_gives_weights_and_options() -> None:
    detector, lines = start("pointpillars-sim")
    stored = read_weights(shipped()["pointpillars-sim"])
    assert detector.config == build("pointpillars", stored.config).config
    for name, value in detector.state_dict().items():
        assert torch.equal(value, stored.tensors[name].to(value.dtype)), name
    total = len(detector.state_dict())
    assert lines == [f"started from pointpillars-sim: {total} of {total} tensors"]


def test_other_classes_keep_the_backbone_and_begin_the_head_anew(tmp_path: Path) -> None:
    torch.manual_seed(1)
    given = build("pointpillars", OPTIONS)
    save_weights(tmp_path / "w.safetensors", given)
    detector, lines = start(tmp_path / "w.safetensors", anchors=[FORKLIFT])
    assert detector.config.classes == ("Forklift",)
    assert detector.config.grid == given.config.grid, "options that are left out are those of the weights"
    old, new = given.state_dict(), detector.state_dict()
    fresh = [name for name in new if old[name].shape != new[name].shape]
    assert fresh and all(name.startswith("head.") for name in fresh)
    assert all(torch.equal(old[name], value) for name, value in new.items() if name not in fresh)
    assert f"{len(new) - len(fresh)} of {len(new)} tensors" in lines[0]
    assert "begun anew, as their shapes differ: head.cls.weight" in lines[1]
    again, _ = start(tmp_path / "w.safetensors", anchors=[FORKLIFT])
    assert all(torch.equal(again.state_dict()[name], new[name]) for name in new), "the new head follows from the seed"


def test_weights_that_cannot_serve(tmp_path: Path) -> None:
    torch.manual_seed(1)
    save_weights(tmp_path / "w.safetensors", build("pointpillars", OPTIONS))
    section = DetectorSection(name="second", start_from=str(tmp_path / "w.safetensors"))
    with pytest.raises(BeamboxError, match="holds a pointpillars, the recipe trains a second"):
        build_detector(section, 0)
    with pytest.raises(
        BeamboxError, match=r'no weights are called "pointpillars-simm".*did you mean "pointpillars-sim"'
    ):
        start("pointpillars-simm")
