"""Outputs recorded from OpenPCDet, reproduced from its checkpoints: every recording found is compared."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from beambox.export.openpcdet import import_checkpoint
from beambox.structures import Batch, Frame
from oracles.paths import fixtures_dir

RELATIVE = 1e-4


def recordings(model: str) -> list[tuple[Path, Path]]:
    """Pair each recording of a model with each of its checkpoints."""
    folder = fixtures_dir("openpcdet")
    pairs = [
        (checkpoint, recording)
        for checkpoint in sorted(folder.glob(f"openpcdet_{model}_*.pth"))
        for recording in sorted(folder.glob(f"{model}_*.npz"))
        if re.fullmatch(rf"{model}_.+", recording.stem)
    ]
    if not pairs:
        pytest.skip(f"no recording of {model} in {folder}")
    return pairs


@cache
def detector(checkpoint: Path, model: str) -> nn.Module:
    return import_checkpoint(checkpoint, model)


def read(path: Path) -> dict[str, Tensor]:
    with np.load(path) as stored:
        return {name: torch.from_numpy(np.asarray(stored[name])) for name in stored.files}


def relative_error(ours: Tensor, theirs: Tensor) -> float:
    """Largest difference, as a share of the largest size of its column."""
    ours, theirs = ours.double(), theirs.double()
    assert ours.shape == theirs.shape
    scale = theirs.abs().amax(dim=0).clamp(min=1e-6)
    return float(((ours - theirs).abs() / scale).max())


def turned(angle: Tensor) -> Tensor:
    """Bring angles into [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def compare_boxes(ours: Tensor, theirs: Tensor) -> None:
    """Compare boxes; headings may differ by whole turns."""
    assert relative_error(ours[:, :6], theirs[:, :6]) < RELATIVE
    assert float(turned(ours[:, 6] - theirs[:, 6]).abs().max()) < RELATIVE * torch.pi


@pytest.mark.parametrize("model", ["pointpillars", "second"])
def test_single_stage_agrees(model):
    for checkpoint, path in recordings(model):
        recorded = read(path)
        network = detector(checkpoint, model)
        batch = Batch.of([Frame(recorded["points"])])
        with torch.inference_mode():
            predictions = network(batch)
            boxes = predictions.decoded()[0]
        voxels = network.pillars if model == "pointpillars" else network.voxels
        assert len(voxels(batch, network.config.grid).index) == int(recorded["num_voxels"])
        assert predictions.cls.shape[1] == int(recorded["total"])
        index = recorded["index"].long()
        assert relative_error(predictions.cls[0, index], recorded["cls"]) < RELATIVE
        compare_boxes(boxes[index], recorded["box"])
