"""What a detector takes, one sweep after the other; and processes that were forked."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox import BeamboxError, Detections, Frame
from beambox.infer.predictor import Detector
from oracles.tiny_detector import street, tiny_model, tiny_weights


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(tiny_model(), device="cpu", precision="float32")


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    for k in range(3):
        (street() + np.float32(0.5 * k)).astype("f4").tofile(tmp_path / f"{k}.bin")
    return tmp_path


def test_folder_pattern_list_and_generator_give_the_same(detector: Detector, drive: Path) -> None:
    paths = sorted(drive.glob("*.bin"))
    wanted = [detector(path) for path in paths]
    assert all(isinstance(one, Detections) and len(one) > 3 for one in wanted) and wanted[0] != wanted[1]
    for given in (drive, str(drive), f"{drive}/*.bin", paths, (str(path) for path in paths), [drive]):
        assert detector(given) == wanted
    assert list(detector.stream(drive)) == wanted
    assert [found.frame_id for found in detector([paths[0], paths[0]])] == ["0", "0"], "a repeat is not dropped"
    assert detector(Frame(torch.from_numpy(street()), "0")) == detector(paths[0])


def test_a_stream_reads_no_further_than_it_is_asked(detector: Detector) -> None:
    drawn = []

    def sensor() -> Iterator[np.ndarray]:
        for k in range(100):
            drawn.append(k)
            yield street()

    stream = detector.stream(sensor())
    next(stream)
    next(stream)
    assert drawn == [0, 1]


def test_batches_of_a_stream_hold_every_sweep(drive: Path) -> None:
    two = Detector(tiny_model(), device="cpu", precision="float32", batch_size=2)
    assert [found.frame_id for found in two.stream(drive)] == ["0", "1", "2"]


@pytest.mark.parametrize("given", [3, None, b"scan.bin", {"scan.bin": 1}, [3]])
def test_what_is_no_input_is_refused(detector: Detector, given: object) -> None:
    with pytest.raises(BeamboxError, match="a detector takes a path, an"):
        detector(given)  # type: ignore[call-overload]


def test_what_is_not_there_is_named(detector: Detector, drive: Path) -> None:
    for given in (drive / "9.bin", str(drive / "*.pcd"), [drive / "9.bin"]):
        with pytest.raises(BeamboxError, match=r"9\.bin is not there|no file fits the pattern"):
            detector(given)


def test_a_model_keeps_its_mode_layer_by_layer() -> None:
    model = tiny_model().train()
    model.backbone.eval()
    before = [layer.training for layer in model.modules()]
    Detector(model, device="cpu")
    assert [layer.training for layer in model.modules()] == before


FORKED = """
import multiprocessing, sys, torch
torch.set_num_threads(2)
import beambox
from oracles.tiny_detector import street
detector = beambox.load(sys.argv[1], device="cpu", precision="float32")
torch.ones(2000, 2000).sum()  # the threads of OpenMP are there before the fork
wanted = detector(street())

def child():
    assert len(detector(street())) == len(wanted)
    assert len(beambox.load(sys.argv[1], device="cpu")(street())) > 0
    print("done", flush=True)

process = multiprocessing.get_context("fork").Process(target=child)
process.start()
process.join(60)
process.kill()
sys.exit(process.exitcode)
"""


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork")
def test_a_forked_process_detects_and_says_that_it_runs_on_one_thread(tmp_path: Path) -> None:
    """With two threads the child hung for ever: OpenMP's threads do not survive a fork."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "2"}
    ran = subprocess.run(
        [sys.executable, "-c", FORKED, tiny_weights(tmp_path)],
        check=False, env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert ran.returncode == 0 and "done" in ran.stdout, ran.stderr
    assert ran.stderr.count("Use spawn") == 1
