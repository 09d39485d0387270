"""A detector that another installed package brings: found by its entry point, built, saved and loaded like ours."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import pytest

from beambox.checks import BeamboxError
from beambox.detectors.catalog import CATALOG, build
from beambox.detectors.weights import load_weights, save_weights

MODULE = """
from dataclasses import dataclass
from torch import nn
from beambox.detectors.catalog import CatalogEntry

@dataclass(frozen=True)
class ToyConfig:
    width: int = 4

class Toy(nn.Module):
    def __init__(self, config):
        super().__init__()
        self.config = config
        self.layer = nn.Linear(config.width, 1)

ENTRY = CatalogEntry(ToyConfig, Toy)
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package of one module and its metadata into a folder on the path, as pip would."""
    (tmp_path / "toy_package.py").write_text(MODULE)
    info = tmp_path / "toy_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[beambox.detectors]\ntoy = toy_package:ENTRY\nbroken = toy_package:Toy\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(metadata, "_cache", None, raising=False)
    yield
    CATALOG.pop("toy", None)
    sys.modules.pop("toy_package", None)


def test_a_detector_from_outside_is_built_saved_and_loaded(package: None, tmp_path: Path) -> None:
    assert "toy" not in CATALOG
    model = build("toy", {"width": 3})
    assert model.layer.in_features == 3
    save_weights(tmp_path / "toy.safetensors", model)
    CATALOG.pop("toy")  # another process has not asked for it yet
    assert load_weights(tmp_path / "toy.safetensors").config.width == 3


def test_its_errors_are_ours(package: None) -> None:
    with pytest.raises(BeamboxError, match='ToyConfig has no field "widht"'):
        build("toy", {"widht": 3})
    with pytest.raises(BeamboxError, match=r'no detector is called "toi" \(did you mean "toy"\?\)'):
        build("toi")
    with pytest.raises(BeamboxError, match=r'"broken".*toy_package:Toy.* must be a .*CatalogEntry, got type'):
        build("broken")
