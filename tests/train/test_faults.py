"""Runs that meet NaN gradients, full disks, damaged checkpoints, a second training and kills at bad moments."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.weights import read_weights
from beambox.train.checkpoint import load_checkpoint
from beambox.train.config import apply_overrides, parse_recipe
from beambox.train.folder import LAST, PREVIOUS, locked
from beambox.train.log import RunLog, Timer
from beambox.train.loop import train
from beambox.train.run import Run
from beambox.train.validate import Score, Validator
from oracles.tiny_training import OPTIONS, recipe, tiny_kitti, tiny_run


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_kitti(tmp_path_factory.mktemp("kitti"))


def whole_recipe(**changes: Any) -> Any:
    source = {"kind": "kitti", "camera_view": False}
    return parse_recipe(
        {
            "name": "tiny",
            "detector": {"name": "pointpillars", "options": OPTIONS},
            "data": [source],
            "optim": {"iterations": 6, "batch": 2},
            "validation": {"source": {**source, "split": "val"}, "every": 2, "recalls": "all"},
            "workers": 0,
            "save_every": 2,
            "precision": "float32",
            **changes,
        }
    )


class Poisoned(torch.autograd.Function):
    """The identity, whose gradient is NaN."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> torch.Tensor:
        return grads[0] * float("nan")


@pytest.mark.parametrize("clip", [10.0, None])
def test_a_gradient_that_is_not_finite_changes_no_weight(
    clip: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tiny_run(tmp_path, recipe(clip=clip))
    run.train_step(run.dataset[0], Timer())
    before = {name: value.clone() for name, value in run.detector.named_parameters()}
    averaged = {name: value.clone() for name, value in run.result.named_parameters()}
    loss = run.detector.loss
    poisoned = lambda *given: {name: Poisoned.apply(value) for name, value in loss(*given).items()}
    monkeypatch.setattr(run.detector, "loss", poisoned)
    with pytest.raises(BeamboxError, match=r"the gradient is not finite at step 1 \(cls [\d.]+, .*, of .* on frames 0"):
        run.train_step(run.dataset[1], Timer())
    assert run.step == 1
    assert all(torch.equal(before[name], value) for name, value in run.detector.named_parameters())
    assert all(torch.equal(averaged[name], value) for name, value in run.result.named_parameters())


def test_one_older_checkpoint_is_kept_and_serves_where_the_last_is_damaged(tmp_path: Path) -> None:
    run = tiny_run(tmp_path)
    run.save()
    assert not (tmp_path / PREVIOUS).exists()
    for step in range(2):
        run.train_step(run.dataset[step], Timer())
        run.save()
    assert [load_checkpoint(tmp_path / name).step for name in (PREVIOUS, LAST)] == [1, 2]
    (tmp_path / LAST).write_bytes((tmp_path / LAST).read_bytes()[:-1000])
    second = tiny_run(tmp_path)
    second.restore()
    assert second.step == 1
    assert "going on with previous.safetensors, the checkpoint before it" in second.notes[0]
    (tmp_path / PREVIOUS).unlink()
    with pytest.raises(BeamboxError, match="is damaged or cut short"):
        tiny_run(tmp_path).restore()


def test_two_trainings_do_not_share_a_folder(data: Path, tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from beambox.train.folder import locked\n"
        "with locked(Path(sys.argv[1])):\n print('held', flush=True); time.sleep(60)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(BeamboxError, match=rf"another training writes into .* \(process {other.pid}\)"):
            train(whole_recipe(), data, tmp_path)
        other.kill()  # the lock goes with its process, whatever ended it
    with locked(tmp_path):
        pass


def test_a_folder_that_cannot_be_written_is_refused_first(data: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BeamboxError, match=r"cannot write into .*give another --out"):
        train(whole_recipe(), data, tmp_path / "file" / "run")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a device that is always full")
def test_a_full_disk_under_the_log_does_not_end_the_run(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "log.jsonl").symlink_to("/dev/full")
    outcome = train(whole_recipe(log_every=1), data, tmp_path / "run")
    assert outcome.finished
    assert capsys.readouterr().out.count("warning: the log cannot be written (No space left on device)") == 1


def test_a_checkpoint_that_finds_no_room_on_the_way_does_not_end_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tiny_run(tmp_path, recipe().model_copy(update={"save_every": 2}))

    def refuse(_: Run) -> None:
        raise BeamboxError("cannot write last.safetensors: No space left on device")

    monkeypatch.setattr(Run, "save", refuse)
    assert run.loop(RunLog(tmp_path, run.total, 0, tensorboard=False))
    assert capsys.readouterr().out.count("No space left on device; training goes on") == 2


def scripted(monkeypatch: pytest.MonkeyPatch, values: list[float]) -> list[float]:
    """Let validations give these values in turn; returns the list of those that were given."""
    given: list[float] = []

    def score(*_: object) -> Score:
        given.append(values[len(given)])
        return Score(given[-1], "scripted", {}, {})

    monkeypatch.setattr(Validator, "__call__", score)
    return given


def test_the_later_of_equals_is_the_best(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for values, expected in (([0.0, 0.0, 0.0], 6), ([5.0, 7.0, 6.0], 4), ([5.0, 5.0, 4.0], 4)):
        scripted(monkeypatch, values)
        out = tmp_path / str(expected) / str(values)
        train(whole_recipe(), data, out)
        assert read_weights(out / "best.safetensors").card["step"] == expected


def test_a_kill_between_saving_and_validating_loses_no_validation(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Validator, "__call__", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train(whole_recipe(), data, tmp_path / "run")
    assert load_checkpoint(tmp_path / "run" / LAST).step == 2
    given = scripted(monkeypatch, [9.0, 3.0, 1.0])
    outcome = train(whole_recipe(), data, tmp_path / "run", resume=True)
    assert given == [9.0, 3.0, 1.0]
    assert outcome.score == 9.0
    assert read_weights(tmp_path / "run" / "best.safetensors").card["step"] == 2
    train(whole_recipe(validation=None), data, tmp_path / "whole")
    one, other = (read_weights(tmp_path / name / "final.safetensors").tensors for name in ("whole", "run"))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_sigterm_ends_every_command_like_ctrl_c() -> None:
    code = (
        "import os, signal, time\n"
        "from beambox.cli import main\n"
        "def stubborn() -> None:\n os.kill(os.getpid(), signal.SIGTERM); time.sleep(60)\n"
        "main.COMMANDS['models'] = ('__main__:stubborn', '')\n"
        "main.main(['models'])"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    ran = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert ran.returncode == 130
    assert ran.stderr == "beambox: interrupted; files already written are whole and stay\n"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_the_order_of_sampled_classes_is_kept(data: Path, tmp_path: Path) -> None:
    sample = {"Pedestrian": 1, "Car": 2, "Cyclist": 3}
    values = apply_overrides({"augment": {"sample": sample}, "seed": 0}, ["seed=1"])
    assert list(values["augment"]["sample"]) == list(sample)
    run_recipe = whole_recipe(augment={"sample": sample}, validation=None)
    outcome = train(run_recipe, data, tmp_path / "run")
    assert outcome.weights is not None
    card = read_weights(outcome.weights).card["recipe"]
    assert list(card["augment"]["sample"]) == list(sample)
    assert list(load_checkpoint(tmp_path / "run" / LAST).recipe["augment"]["sample"]) == list(sample)


def test_a_log_tells_folder_and_precision(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train(whole_recipe(augment={"sample": {"Car": 1}}), data, tmp_path / "run")
    printed = capsys.readouterr().out
    assert f"cutting objects out of the 5 frames of {data} train" in printed
    assert "{data}" not in printed
    assert "1 x cpu, float32, " in printed
    assert "mean 0.00 (float32)" in printed
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in logged if "validation/Car" in line] == [2, 4, 6]


def test_no_two_random_streams_of_a_run_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys that differ in trailing zeros alone give the same numbers; none of those that a run uses do."""
    import numpy as np

    from beambox.data.mixture import MixedSource
    from beambox.data.sampling import _permutation
    from oracles.tiny_training import frames

    mixture = MixedSource([frames(3), frames(4), frames(2)])
    keys: set[tuple[int, ...]] = set()
    make = np.random.default_rng
    monkeypatch.setattr(np.random, "default_rng", lambda key: (keys.add(tuple(key)), make(key))[1])
    _permutation.cache_clear()
    for epoch in range(4):
        mixture.epoch_indices(0, epoch)
    stripped = [tuple(np.trim_zeros(key, "b")) for key in keys]
    assert len(keys) > 10
    assert len(set(stripped)) == len(stripped)
    assert all(
        make(key).integers(1 << 60) == make(short or (0,)).integers(1 << 60) for key, short in zip(keys, stripped)
    )
