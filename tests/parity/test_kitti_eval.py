"""Every recording of KITTI's official evaluator that is at hand is reproduced to 0.01."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from beambox.metrics.kitti import KittiResult, evaluate_files
from oracles.paths import data_dir, fixtures_dir

METRICS = {"detection": "image", "detection_ground": "bev", "detection_3d": "box3d", "orientation": "orientation"}


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    archive = data_dir("kitti_labels.tar.gz")
    out = tmp_path_factory.mktemp("kitti_labels")
    with tarfile.open(archive) as tar:
        tar.extractall(out, [m for m in tar.getmembers() if "/label_2/" in m.name and m.isfile()], filter="data")
    return out


def _recordings() -> list[Path]:
    return sorted(fixtures_dir().glob("kitti_eval*/**/expected*.json"))


def _compare(result: KittiResult, expected: dict) -> int:
    compared = 0
    for key, values in expected.items():
        name, metric = key.split("_", 1)
        averages = getattr(result[name.capitalize()], METRICS[metric])
        for kind, numbers in values.items():
            if kind in ("AP_R11", "AP_R40"):
                ours = [a.r11 if kind == "AP_R11" else a.r40 for a in averages]
                np.testing.assert_allclose(ours, numbers, atol=0.01, err_msg=f"{key} {kind}")
                compared += 1
            elif np.shape(numbers) == (len(averages), 41):  # precision at the 41 recalls, in [0, 1] or percent
                scale = 100 if np.max(numbers) > 1 else 1
                ours = np.array([a.curve for a in averages]) * scale
                np.testing.assert_allclose(ours, numbers, atol=1e-4 * scale, err_msg=f"{key} {kind}")
                compared += 1
    return compared


def test_official_evaluator_is_reproduced(labels: Path, tmp_path: Path) -> None:
    recordings = _recordings()
    if not recordings:
        pytest.skip("no recording of KITTI's evaluator is at hand")
    for number, path in enumerate(recordings):
        recorded = json.loads(path.read_text(encoding="utf-8"))
        out = tmp_path / str(number)
        with tarfile.open(path.with_name(path.name.replace("expected", "data").replace(".json", ".tar.gz"))) as tar:
            tar.extractall(out, filter="data")
        overlap = {name.capitalize(): value for name, value in recorded.get("min_overlap", {}).items()}
        result = evaluate_files(labels, out, recorded["frames"], min_overlap=overlap)
        assert _compare(result, recorded["expected"]) > 0
