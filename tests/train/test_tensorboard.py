"""TensorBoard holds losses, scores, pictures of validation frames and precision-recall curves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import beambox
from beambox.train.log import RunLog
from oracles.tiny_training import OPTIONS, tiny_kitti

accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")


def events(folder: Path) -> object:
    read = accumulator.EventAccumulator(str(folder), size_guidance={"images": 0, "tensors": 0})
    return read.Reload()


def test_a_validation_leaves_pictures_and_curves(tmp_path: Path) -> None:
    recipe = {
        "name": "tiny",
        "detector": {"name": "pointpillars", "options": OPTIONS},
        "data": [{"kind": "kitti"}],
        "optim": {"iterations": 2, "batch": 2},
        "validation": {"source": {"kind": "kitti", "split": "val"}, "every": 1, "recalls": "all", "level": "all"},
        "workers": 0,
        "precision": "float32",
    }
    (tmp_path / "recipe.yaml").write_text(json.dumps(recipe))
    beambox.train(tmp_path / "recipe.yaml", tiny_kitti(tmp_path / "kitti"), tmp_path / "run")
    found = events(tmp_path / "run" / "tensorboard")
    tags = found.Tags()
    assert {"loss/total", "validation/Car"} <= set(tags["scalars"])
    assert {"validation/000000", "validation/000001"} == set(tags["images"])
    assert [one.step for one in found.Images("validation/000000")] == [1, 2]
    assert "validation/Car" in tags["tensors"]


def test_a_curve_is_written_as_it_is(tmp_path: Path) -> None:
    from tensorboard.util import tensor_util

    log = RunLog(tmp_path, 10, 0)
    log.curves(4, {"Car": (20, (1.0, 0.8, 0.5))})
    log.close()
    (event,) = events(tmp_path / "tensorboard").Tensors("validation/Car")
    hits, false, _, missed, precision, recall = tensor_util.make_ndarray(event.tensor_proto)
    assert event.step == 4
    np.testing.assert_allclose(precision, [0.5, 0.8, 1.0])
    np.testing.assert_allclose(recall, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(hits, [20, 10, 0])
    np.testing.assert_allclose(false, [20, 2.5, 0], rtol=1e-6)
    np.testing.assert_allclose(missed, [0, 10, 20])


def test_a_full_disk_costs_pictures_and_not_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = RunLog(tmp_path, 10, 0)

    class Full:
        def add_pr_curve_raw(self, *_: object) -> None:
            raise OSError(28, "No space left on device")

        def close(self) -> None:
            pass

    log._board = Full()
    log.curves(1, {"Car": (1, (1.0,)), "Van": (1, (1.0,))})
    log.close()
    assert capsys.readouterr().out.count("training goes on") == 1
