"""Two processes that share a batch do what one process does with the whole of it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from beambox.checks import BeamboxError
from oracles import ddp_worker
from oracles.tiny_training import recipe, tiny_run


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.slow
def test_two_processes_equal_one_with_the_joint_batch(tmp_path: Path) -> None:
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
            [sys.executable, ddp_worker.__file__, str(tmp_path)],
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in (0, 1)
    ]
    outputs = [process.communicate(timeout=240)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], "\n".join(outputs)
    distributed = load_file(tmp_path / "distributed.safetensors")
    run = tiny_run(tmp_path, recipe(batch=4), window=None)
    totals = torch.tensor(ddp_worker.steps_of(run))
    torch.testing.assert_close(distributed.pop("totals"), totals, rtol=1e-5, atol=1e-6)
    for name, value in run.detector.state_dict().items():
        torch.testing.assert_close(distributed[name], value, rtol=1e-4, atol=1e-6, msg=name)


def test_a_batch_that_cannot_be_shared_evenly_is_refused(tmp_path: Path) -> None:
    feed = tiny_run(tmp_path).feed
    with pytest.raises(BeamboxError, match=r"optim\.batch = 2 frames cannot be shared evenly by 3 processes"):
        type(feed)(feed.source, feed.change, feed.classes, feed.grid, 2, world=3)
