"""The public names: all there, listed once, and not to be removed by accident."""

from __future__ import annotations

import subprocess
import sys

import pytest

import beambox

PUBLIC = (
    "Batch",
    "BeamboxError",
    "Calibration",
    "Detection",
    "Detections",
    "Detector",
    "Frame",
    "KittiSource",
    "Label",
    "Labels",
    "VoxelGrid",
    "draw",
    "evaluate",
    "export",
    "load",
    "open_dataset",
    "read_frame",
    "recipes",
    "simulate",
    "train",
)


def test_no_public_name_has_gone() -> None:
    assert set(PUBLIC) <= set(beambox.__all__), "removing a public name breaks the code of others: see CHANGELOG.md"


def test_every_public_name_is_listed_here() -> None:
    assert set(beambox.__all__) <= set(PUBLIC), "a new public name is added to this list on purpose"


@pytest.mark.parametrize("name", beambox.__all__)
def test_public_names_resolve_to_what_is_documented(name: str) -> None:
    thing = vars(beambox).get(name) or beambox.__getattr__(name)
    assert callable(thing) and thing.__doc__, name
    assert name in dir(beambox)


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="module 'beambox' has no attribute 'laod'"):
        beambox.laod  # type: ignore[attr-defined]  # noqa: B018


def test_the_version_is_the_installed_one() -> None:
    output = subprocess.run(
        [sys.executable, "-m", "beambox", "--version"], capture_output=True, text=True, check=True,
        env={"PYTHONPATH": str(__import__("pathlib").Path(beambox.__file__).parents[1])},
    ).stdout  # fmt: skip
    assert output.strip() == f"beambox {beambox.__version__}"
