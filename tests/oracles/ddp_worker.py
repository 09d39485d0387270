"""One process of a distributed run of the tiny detector, as torchrun starts it; the first writes the result."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from safetensors.torch import save_file

from beambox.train.log import Timer
from beambox.train.loop import Run
from oracles.tiny_training import recipe, tiny_run

STEPS = 3


def steps_of(run: Run) -> list[float]:
    """Train a few steps with fixed batch-norm statistics; returns the losses averaged over the processes."""
    totals = []
    run.module.eval()
    for step in range(STEPS):
        losses, _ = run.train_step(run.dataset[step], Timer())
        total = run.fabric.all_reduce(losses["total"])
        assert isinstance(total, torch.Tensor)
        totals.append(total.item())
    return totals


if __name__ == "__main__":
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    run = tiny_run(folder, recipe(batch=4), window=None)
    totals = steps_of(run)
    if run.fabric.global_rank == 0:
        weights = {name: value.contiguous() for name, value in run.detector.state_dict().items()}
        save_file({**weights, "totals": torch.tensor(totals)}, folder / "distributed.safetensors")
    run.fabric.barrier()
