"""One process of a whole distributed run from files, as torchrun starts it; arguments: data, folder of the run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch

from beambox.train.config import parse_recipe
from beambox.train.loop import train
from oracles.tiny_training import OPTIONS


def recipe() -> Any:
    """A run of forty steps with a validation on the way and one at the end."""
    source = {"kind": "kitti", "camera_view": False}
    return parse_recipe(
        {
            "name": "tiny",
            "detector": {"name": "pointpillars", "options": OPTIONS},
            "data": [source],
            "augment": {"sample": {"Car": 1}},
            "optim": {"iterations": 40, "batch": 2, "lr": 0.01},
            "validation": {"source": source, "every": 20, "recalls": "all", "view": "bev", "iou": {"Car": 0.1}},
            "workers": 0,
            "log_every": 10,
            "precision": "float32",
        }
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    outcome = train(recipe(), Path(sys.argv[1]), Path(sys.argv[2]))
    assert outcome.finished
    print(f"score {outcome.score}")
