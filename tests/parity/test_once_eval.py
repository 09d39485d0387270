"""Every recording of ONCE's official evaluator that is at hand is reproduced to 0.01."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest

from beambox.metrics.once import evaluate_annotations
from oracles.paths import ROOT, fixtures_dir


def test_official_devkit_is_reproduced() -> None:
    recordings = sorted(fixtures_dir().glob("once_eval*/**/expected*.json"))
    if not recordings:
        pytest.skip("no recording of ONCE's evaluator is at hand")
    for path in recordings:
        expected = json.loads(path.read_text(encoding="utf-8"))
        compare(path.with_name(path.name.replace("expected", "annotations")), expected)


def test_the_recording_in_the_repository_is_reproduced(tmp_path: Path) -> None:
    """It goes with every clone; made-up scenes, scored by the official devkit."""
    folder = ROOT / "tests" / "fixtures" / "once_eval"
    annotations = tmp_path / "annotations.json"
    annotations.write_bytes(gzip.decompress((folder / "annotations.json.gz").read_bytes()))
    compare(annotations, json.loads((folder / "expected.json").read_text(encoding="utf-8")))


def compare(annotations: Path, expected: dict) -> None:
    """Score the annotations in both ways that the devkit knows, and hold each number against the recorded one."""
    compared = 0
    for mode, five_classes in (("superclass", False), ("five_classes", True)):
        ours = evaluate_annotations(annotations, five_classes=five_classes).to_json()
        for key, value in expected.get(mode, {}).items():
            name, band = key.removeprefix("AP_").split("/")
            assert ours[name][band] == pytest.approx(value, abs=0.01), f"{annotations} {mode} {key}"
            compared += 1
    assert compared > 0
