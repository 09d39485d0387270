"""Choosing a backend: best first, reasons, pinning, and no import before its time."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.ops import dispatch
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose
from beambox.ops.nms import nms

ROOT = Path(__file__).resolve().parents[2]
X = torch.zeros(2)


def refuse(*tensors):
    return "it is Sunday"


FIRST = Backend("triton", refuse, lambda: lambda: "triton")
SECOND = Backend("numba", always, lambda: lambda: "numba")
LAST = Backend("reference", always, lambda: lambda: "reference")


@pytest.fixture(autouse=True)
def no_pin(monkeypatch):
    monkeypatch.delenv("BEAMBOX_BACKEND", raising=False)


def test_choose_takes_the_first_that_can_run_and_logs_why_once(caplog):
    dispatch._log_once.cache_clear()
    with caplog.at_level(logging.DEBUG, logger="beambox.ops.dispatch"):
        for _ in range(3):
            assert choose("sing", (FIRST, SECOND, LAST), X)() == "numba"
    assert [r.getMessage() for r in caplog.records] == ["sing runs its numba version (not triton: it is Sunday)"]


@pytest.mark.parametrize("name", ["numba", "reference"])
def test_choose_obeys_the_pin(monkeypatch, name):
    monkeypatch.setenv("BEAMBOX_BACKEND", name)
    assert choose("sing", (FIRST, SECOND, LAST), X)() == name


def test_pinned_backend_that_cannot_run_raises_with_its_reason(monkeypatch):
    monkeypatch.setenv("BEAMBOX_BACKEND", "triton")
    with pytest.raises(
        BeamboxError, match="sing: BEAMBOX_BACKEND=triton asks for the triton version, but it is Sunday"
    ):
        choose("sing", (FIRST, SECOND, LAST), X)


def test_pin_without_such_a_version_runs_the_reference(monkeypatch):
    monkeypatch.setenv("BEAMBOX_BACKEND", "triton")
    assert choose("sing", (SECOND, LAST), X)() == "reference"


def test_unknown_pin_is_told_with_a_guess(monkeypatch):
    monkeypatch.setenv("BEAMBOX_BACKEND", "nunba")
    with pytest.raises(
        BeamboxError, match=r'must be one of reference, numba, triton, got .nunba. \(did you mean "numba"'
    ):
        choose("sing", (SECOND, LAST), X)


def test_predicates_give_reasons_with_values():
    assert can_run_numba(X, X.long()) is None
    assert can_run_numba(torch.zeros(1, device="meta")) == "a tensor is on meta, numba runs on the CPU"
    assert "a tensor is float16" in can_run_numba(X.half())
    assert "a tensor is on cpu, Triton needs a CUDA device" in can_run_triton(X)


def test_predicates_see_what_is_not_installed(monkeypatch):
    monkeypatch.setattr(dispatch, "_installed", lambda package: False)
    assert can_run_numba(X) == "numba is not installed"
    assert can_run_triton(X) == "triton is not installed"


def test_an_operation_refuses_a_pin_it_cannot_follow(monkeypatch):
    monkeypatch.setenv("BEAMBOX_BACKEND", "numba")
    with pytest.raises(BeamboxError, match=r"nms: BEAMBOX_BACKEND=numba .* float16"):
        nms(torch.zeros(1, 7).half(), torch.zeros(1).half(), 0.5)


def test_importing_operations_imports_neither_numba_nor_triton():
    code = (
        "import sys; import torch; before = set(sys.modules)\n"
        "import beambox.ops.voxelize, beambox.ops.scatter, beambox.ops.rotated_iou, beambox.ops.nms\n"
        "import beambox.ops.points_in_boxes, beambox.ops.ball_count, beambox.ops.neighborhood\n"
        "new = {name.split('.')[0] for name in set(sys.modules) - before}\n"
        "print(sorted(new & {'numba', 'triton', 'llvmlite'}))"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
