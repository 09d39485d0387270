"""A paper is read in one place: what one forward pass executes, and which layers belong to one detector alone."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch

import beambox
from beambox.detectors.catalog import CATALOG
from beambox.structures import Batch
from oracles.small_detectors import CAR, build_small, car_frame

PACKAGE = Path(beambox.__file__).parent
SHARED = ("layers", "ops", "geometry", "structures")
"""Named shared layers, operations, and what lies below them."""


def files_executed(call: Any) -> set[str]:
    """Return the files of this package whose functions a call runs, without those of :data:`SHARED` and checks."""
    seen: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            seen.add(frame.f_code.co_filename)

    former = sys.getprofile()
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(former)
    ours = [Path(name).relative_to(PACKAGE) for name in seen if Path(name).is_relative_to(PACKAGE)]
    return {str(path) for path in ours if path.parts[0] not in SHARED and path.name != "checks.py"}


@pytest.mark.parametrize("name", CATALOG)
def test_one_forward_runs_at_most_two_files_beyond_the_shared_layers(name: str) -> None:
    model = build_small(name).eval()
    batch = Batch.of([car_frame(1, CAR)])
    with torch.inference_mode():
        files = files_executed(lambda: model(batch))
    assert len(files) <= 2, files
    assert any(name in file for file in files), files


def test_layers_hold_what_two_detectors_share() -> None:
    users: dict[str, set[str]] = {path.stem: set() for path in (PACKAGE / "layers").glob("*.py")}
    for path in PACKAGE.rglob("*.py"):
        inside = path.relative_to(PACKAGE).parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("beambox.layers."):
                users[(node.module or "").split(".")[2]].add(inside[1] if inside[0] == "detectors" else inside[0])
    del users["__init__"]
    alone = {layer for layer, by in users.items() if len(by) < 2 and "layers" not in by}
    assert not alone, alone
