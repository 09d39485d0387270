"""What is compiled ahead of time, and what is said while compiling."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numba
import pytest

from beambox.infer import warm_up as module
from beambox.infer.warm_up import steps_to_warm, warm_up
from beambox.progress import CompileNotice
from oracles.command_line import beambox
from oracles.tiny_detector import tiny_weights


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_each_detector_with_weights_detects_and_learns_once() -> None:
    steps = steps_to_warm()
    names = [name for what, name in steps if what == "detect"]
    assert sorted(name.split("-")[0] for name in names) == ["dennet", "hcnet", "kassd", "pointpillars", "voxel_rcnn"]
    assert [name for what, name in steps if what == "train"] == names
    assert steps_to_warm(training=False) == [step for step in steps if step[0] != "train"]


def test_all_steps_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    weights = str(tiny_weights(tmp_path))
    steps = [("simulate", ""), ("detect", weights), ("train", weights), ("score", "")]
    said: list[str] = []
    done = list(warm_up(steps, "cpu", said.append))
    assert [what for what, _ in done] == said == [f"{what} {name}".strip() for what, name in steps]
    assert all(seconds > 0 for _, seconds in done)
    monkeypatch.setattr(module, "steps_to_warm", lambda training: [("score", "")] if training else [])
    ran = beambox(capsys, "setup", "--device", "cpu")
    assert ran.status == 0 and "score" in ran.out and "ready: 1 steps" in ran.out


def test_compiling_is_announced_on_a_terminal_alone_and_not_at_each_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("beambox.progress.time.monotonic", lambda: now[0])
    for stream, lines in ((Terminal(), 2), (io.StringIO(), 0)):
        monkeypatch.setattr(sys, "stderr", stream)
        notice = CompileNotice()
        for wait in (0.0, 1.0, 1.0, 1.5, 0.5):
            now[0] += wait
            notice()
        assert notice.count == 5
        assert len(stream.getvalue().splitlines()) == lines
        assert not lines or "4 so far, 4 s" in stream.getvalue()


def test_numba_tells_of_our_kernels_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    from beambox.ops import jit

    heard: list[int] = []
    monkeypatch.setattr(jit._Compiled, "notice", staticmethod(lambda: heard.append(1)))

    def ours(x: float) -> float:
        return x + 1

    def theirs(x: float) -> float:
        return x + 2

    ours.__module__ = "beambox.ops.example"
    theirs.__module__ = "elsewhere"
    assert numba.njit(theirs)(1.0) == 3.0 and not heard
    kernel = numba.njit(ours)
    assert kernel(1.0) == 2.0 and kernel(3.0) == 4.0
    assert len(heard) == 1, "once for each kernel and type"
