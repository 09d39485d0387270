"""The log for rerun; without the package, what to install is said."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError, how_to_install
from beambox.structures import Detections, Frame, Labels
from beambox.visualize.rerun_log import RerunLog
from oracles.command_line import beambox
from oracles.tiny_detector import street, tiny_weights

ABSENT = importlib.util.find_spec("rerun") is None
NEEDED = pytest.mark.skipif(ABSENT, reason=f"needs rerun-sdk: {how_to_install('rerun')}")


@pytest.mark.skipif(not ABSENT, reason="rerun-sdk is installed")
def test_without_the_package_the_extra_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    street().tofile(tmp_path / "scan.bin")
    ran = beambox(capsys, "view", tmp_path / "scan.bin", "--out", tmp_path / "a.rrd")
    assert ran.status == 2 and 'pip install ".[rerun]"' in ran.err


def test_a_wrong_ending_is_refused_before_anything_else(tmp_path: Path) -> None:
    with pytest.raises(BeamboxError, match=r"written as \.rrd"):
        RerunLog(tmp_path / "a.html")


@NEEDED
def test_a_recording_holds_sweeps_boxes_and_scores(tmp_path: Path) -> None:
    log = RerunLog(tmp_path / "a.rrd")
    box = torch.tensor([[10.0, 2.0, -1.0, 4.0, 1.8, 1.5, 0.5]])
    found = Detections(box, torch.tensor([0.75]), torch.tensor([0]), ("Car",))
    points = torch.cat((torch.rand(500, 4), torch.tensor([[float("nan")] * 4])))
    for k in range(2):
        log.add(
            Frame(points, f"{k}"),
            found,
            Labels(box, ("Van",)),
            tracks=np.array([42]),
            scores=np.random.default_rng(0).random((20, 30)),
            seconds=0.1 * k,
        )
    log.add(Frame(torch.zeros(0, 4)), Detections.empty(("Car",)))
    assert log.close() == 3
    content = (tmp_path / "a.rrd").read_bytes()
    assert content[:3] == b"RRF" and len(content) > 10_000


@NEEDED
def test_the_command_detects_and_writes_a_recording(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    street().tofile(tmp_path / "scan.bin")
    ran = beambox(capsys, "view", tmp_path / "scan.bin", "-m", tiny_weights(tmp_path), "--out", tmp_path / "a.rrd")
    assert ran.status == 0, ran.err
    assert (tmp_path / "a.rrd").stat().st_size > 50_000
