"""The training loop: it learns, resumes bit by bit, and stops with a reason."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.weights import load_weights
from beambox.train.dataset import TrainingBatch
from beambox.train.log import RunLog, Timer
from beambox.train.loop import Run
from oracles.tiny_training import recipe, tiny_run


def train_until(run: Run, until: int) -> list[float]:
    """Train up to a step; returns the total losses."""
    run.module.train()
    totals = []
    while run.step < until:
        losses, _ = run.train_step(run.dataset[run.step], Timer())
        totals.append(losses["total"].item())
    return totals


def state(run: Run) -> dict[str, torch.Tensor]:
    assert run.ema is not None
    return {**run.detector.state_dict(), **{f"ema.{k}": v for k, v in run.ema.module.state_dict().items()}}


def test_resumed_run_equals_uninterrupted_one_bit_by_bit(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole")
    losses = train_until(whole, 6)
    first = tiny_run(tmp_path / "cut")
    train_until(first, 3)
    first.save()
    second = tiny_run(tmp_path / "cut", recipe(), count=5)
    with torch.no_grad():
        for parameter in second.detector.parameters():
            parameter.add_(1.0)  # nothing of the fresh weights may survive
    second.restore()
    assert second.step == 3
    assert train_until(second, 6) == losses[3:]
    for name, value in state(whole).items():
        assert torch.equal(value, state(second)[name]), name


def test_loss_falls_on_one_frame(tmp_path: Path) -> None:
    run = tiny_run(tmp_path, recipe(iterations=60, batch=1, lr=0.01), count=1, window=None)
    losses = train_until(run, 60)
    assert sum(losses[-5:]) < 0.4 * sum(losses[:5])


def test_loop_writes_log_checkpoint_and_loadable_weights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_recipe = recipe().model_copy(update={"log_every": 2, "save_every": 4})
    run = tiny_run(tmp_path, run_recipe)
    log = RunLog(tmp_path, run.total, 0, tensorboard=False)
    assert run.loop(log)
    log.close()
    printed = capsys.readouterr().out
    assert "direction" in printed
    assert "% forward" in printed
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 6]
    assert lines[0]["loss/total"] == pytest.approx(sum(lines[0][f"loss/{k}"] for k in ("cls", "loc", "direction")))
    run.export("final.safetensors", {})
    loaded = load_weights(tmp_path / "final.safetensors")
    for name, value in run.result.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name])


def test_signal_stops_after_the_step_and_resuming_goes_on(tmp_path: Path) -> None:
    run_recipe = recipe().model_copy(update={"log_every": 1})
    run = tiny_run(tmp_path, run_recipe)

    class Interrupting(RunLog):
        def progress(self, step: int) -> None:
            if step == 2:
                os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    assert not run.loop(Interrupting(tmp_path, run.total, 0, tensorboard=False))
    assert run.step == 2
    assert signal.getsignal(signal.SIGINT) is before


def test_loss_that_is_not_finite_stops_and_shows_its_parts(tmp_path: Path) -> None:
    run = tiny_run(tmp_path)
    with torch.no_grad():
        run.detector.head.cls.bias.fill_(float("nan"))
    with pytest.raises(BeamboxError, match=r"loss is not finite at step 0 \(cls nan, loc .*\) on frames 0"):
        train_until(run, 1)


def test_batch_without_objects_trains(tmp_path: Path) -> None:
    from dataclasses import replace

    from beambox.structures import Labels

    run = tiny_run(tmp_path)
    work = run.dataset[0]
    empty = TrainingBatch(replace(work.batch, labels=(Labels.empty(),) * 2), work.grid)
    losses, _ = run.train_step(empty, Timer())
    assert torch.isfinite(losses["total"])


def test_dense_layers_are_compiled_where_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[torch.nn.Module] = []
    monkeypatch.setattr(torch.nn.Module, "compile", lambda layer, **_: compiled.append(layer))
    tiny_run(tmp_path, recipe())
    assert compiled == []
    run = tiny_run(tmp_path, recipe().model_copy(update={"compile": True}))
    assert compiled == list(run.detector.dense)
