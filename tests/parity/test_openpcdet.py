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
from beambox.layers.encoders import mean_voxels
from beambox.layers.roi import Rois, decode_rois
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
        assert len(network.voxels(batch, network.config.grid).index) == int(recorded["num_voxels"])
        assert predictions.cls.shape[1] == int(recorded["total"])
        index = recorded["index"].long()
        assert relative_error(predictions.cls[0, index], recorded["cls"]) < RELATIVE
        compare_boxes(boxes[index], recorded["box"])


def test_two_stage_agrees():
    for checkpoint, path in recordings("voxel_rcnn"):
        recorded = read(path)
        network = detector(checkpoint, "voxel_rcnn")
        batch = Batch.of([Frame(recorded["points"])])
        given = recorded["rois"]
        zeros = torch.zeros(len(given), dtype=torch.int64)
        with torch.inference_mode():
            predictions = network(batch)
            grid = network.config.grid
            stages = network.encoder(mean_voxels(network.voxels(batch, grid)))
            pooled = network.roi_pool(Rois(given, zeros, zeros, 1), network.levels(stages), grid)
            refined = network.roi_head(pooled)
            boxes = decode_rois(refined.deltas, given)
        index = recorded["rpn_index"].long()
        assert relative_error(predictions.first.cls[0, index], recorded["rpn_cls"]) < RELATIVE
        compare_boxes(predictions.first.decoded()[0, index], recorded["rpn_box"])
        assert relative_error(refined.cls[:, None], recorded["rcnn_cls"]) < RELATIVE
        # The second stage moves its regions little: its own work is the difference.
        ours, theirs = boxes - given, recorded["rcnn_box"] - given
        ours[:, 6], theirs[:, 6] = turned(ours[:, 6]), turned(theirs[:, 6])
        assert relative_error(ours, theirs) < RELATIVE
