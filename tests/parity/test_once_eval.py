"""Every recording of ONCE's official evaluator that is at hand is reproduced to 0.01."""

from __future__ import annotations

import json

import pytest

from beambox.metrics.once import evaluate_annotations
from oracles.paths import fixtures_dir


def test_official_devkit_is_reproduced() -> None:
    recordings = sorted(fixtures_dir().glob("once_eval*/**/expected*.json"))
    if not recordings:
        pytest.skip("no recording of ONCE's evaluator is at hand")
    for path in recordings:
        expected = json.loads(path.read_text(encoding="utf-8"))
        annotations = path.with_name(path.name.replace("expected", "annotations"))
        compared = 0
        for mode, five_classes in (("superclass", False), ("five_classes", True)):
            ours = evaluate_annotations(annotations, five_classes=five_classes).to_json()
            for key, value in expected.get(mode, {}).items():
                name, band = key.removeprefix("AP_").split("/")
                assert ours[name][band] == pytest.approx(value, abs=0.01), f"{path.parent.name} {mode} {key}"
                compared += 1
        assert compared > 0
