"""Two processes that share a batch do what one process does with the whole of it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from beambox.checks import BeamboxError
from beambox.data.database import ObjectDatabase
from beambox.data.mixture import MixedSource
from beambox.detectors.catalog import build
from beambox.detectors.weights import load_weights
from beambox.train.batchnorm import batch_norms, measure_statistics
from beambox.train.config import read_recipe
from beambox.train.dataset import TrainingDataset
from beambox.train.preflight import check_recipe
from beambox.train.sources import Augment, open_source
from beambox.train.validate import Validator
from oracles import ddp_train, ddp_worker
from oracles.tiny_training import recipe, tiny_kitti, tiny_run


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def run_two(script: str, *arguments: object) -> list[str]:
    """Run a script in two processes as torchrun does; returns what each printed."""
    shared = {
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(free_port()),
        "WORLD_SIZE": "2",
        "LOCAL_WORLD_SIZE": "2",
        "GROUP_RANK": "0",
        "TORCHELASTIC_RUN_ID": "test",
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    processes = [
        subprocess.Popen(
            [sys.executable, script, *map(str, arguments)],
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in (0, 1)
    ]
    outputs = [process.communicate(timeout=240)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], "\n".join(outputs)
    return outputs


@pytest.mark.slow
def test_a_whole_run_validates_in_shares_and_exports_statistics_of_all_processes(tmp_path: Path) -> None:
    data = tiny_kitti(tmp_path / "data")
    outputs = run_two(ddp_train.__file__, data, tmp_path / "run")
    assert not any("Grad strides" in output for output in outputs), outputs[0]
    scores = [output.splitlines()[-1] for output in outputs]
    assert scores[0] == scores[1], "all processes know the score"
    weights = tmp_path / "run" / "final.safetensors"
    run_recipe, final = ddp_train.recipe(), load_weights(weights)
    source = open_source(run_recipe.validation.source, data)
    logged = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    last = [line for line in logged if "validation/Car" in line][-1]
    assert last["step"] == 40
    assert last["validation/Car"] > 5
    score = Validator(run_recipe.validation, source)(final)
    assert score.value == pytest.approx(last["validation/Car"]), "one process scores the same in all frames"
    assert len(source) % 2, "shares of different lengths"
    feeds = [feed_of(run_recipe, data, rank) for rank in (0, 1)]
    for layer in batch_norms(final).values():
        assert layer.running_mean is not None
        layer.running_mean.fill_(9.0)
    steps = [dataset[step] for step in range(40) for dataset in feeds]
    measure_statistics(final, steps, lambda work: final(work.batch, work.grid))
    for name, value in load_weights(weights).state_dict().items():
        torch.testing.assert_close(value, final.state_dict()[name], rtol=1e-5, atol=1e-6, msg=name)


def feed_of(run_recipe: Any, data: Path, rank: int) -> TrainingDataset:
    """What a process of the run drew."""
    config = build(run_recipe.detector.name, run_recipe.detector.options).config
    change = Augment(run_recipe.augment, ObjectDatabase.load(data.parent / "run" / "objects.npz"), run_recipe.seed)
    source = MixedSource([open_source(section, data) for section in run_recipe.data])
    return TrainingDataset(source, change, config.classes, config.grid, run_recipe.optim.batch, rank=rank, world=2)


@pytest.mark.slow
def test_two_processes_equal_one_with_the_joint_batch(tmp_path: Path) -> None:
    run_two(ddp_worker.__file__, tmp_path)
    distributed = load_file(tmp_path / "distributed.safetensors")
    run = tiny_run(tmp_path, recipe(batch=4), window=None)
    totals = torch.tensor(ddp_worker.steps_of(run))
    torch.testing.assert_close(distributed.pop("totals"), totals, rtol=1e-5, atol=1e-6)
    for name, value in run.detector.state_dict().items():
        torch.testing.assert_close(distributed[name], value, rtol=1e-4, atol=1e-6, msg=name)


def test_a_batch_that_cannot_be_shared_evenly_is_refused(tmp_path: Path) -> None:
    dataset = tiny_run(tmp_path).dataset
    with pytest.raises(BeamboxError, match=r"optim\.batch = 2 frames cannot be shared evenly by 3 processes"):
        type(dataset)(dataset.source, dataset.augment, dataset.classes, dataset.grid, 2, world=3)


def test_the_documented_commands_fit_their_recipes() -> None:
    import re

    root = Path(__file__).resolve().parents[2]
    text = (root / "docs" / "training.md").read_text(encoding="utf-8")
    commands = re.findall(r"torchrun --nproc-per-node (\d+) .* train (\S+)(.*)", text)
    assert len(commands) >= 2
    for processes, name, rest in commands:
        run_recipe = read_recipe(name, re.findall(r"--set (\S+)", rest))
        check_recipe(run_recipe, build(run_recipe.detector.name, run_recipe.detector.options).config, int(processes))
