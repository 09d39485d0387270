"""Voxel R-CNN: sizes, losses, decoding, gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.voxel_rcnn import KITTI, ONCE, VoxelRcnn, VoxelRcnnConfig, voxel_rcnn
from beambox.geometry.grid import VoxelGrid
from beambox.layers.roi import ProposalLimits, RoiSampling
from beambox.structures import Batch, Frame, Labels

SMALL = replace(
    VoxelRcnnConfig(),
    grid=VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 1.0), (0.1, 0.1, 0.1)),
    encoder_widths=(4, 4, 8, 8),
    encoder_out=8,
    depths=(1, 1),
    widths=(8, 8),
    up_widths=(8, 8),
    train_proposals=ProposalLimits(200, 20, 0.8),
    test_proposals=ProposalLimits(100, 10, 0.7),
    sampling=RoiSampling(per_sample=8),
    lattice=2,
    roi_width=16,
)


def sweep(seed: int, points: int = 500) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.rand((points, 4), generator=generator) * torch.tensor([12.0, 12.0, 3.5, 1.0])
    labels = Labels(torch.tensor([[6.0, 0, -1, 4, 1.6, 1.5, 0.3]]), ("Car",))
    return Frame(xyz - torch.tensor([0.0, 6.0, 3.0, 0.0]), labels=labels)


@pytest.fixture
def small() -> VoxelRcnn:
    torch.manual_seed(0)
    return voxel_rcnn(SMALL)


def test_parameters_of_the_published_network():
    assert sum(p.numel() for p in voxel_rcnn().parameters()) == pytest.approx(7.587e6, rel=0.001)


def test_classes_of_the_configurations():
    assert VoxelRcnnConfig().classes == ("Car",)
    assert KITTI.classes == ("Car", "Pedestrian", "Cyclist")
    assert ONCE.classes == ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")
    with pytest.raises(BeamboxError, match="levels of stride 2, 4 or 8"):
        VoxelRcnnConfig(pooling=())


def test_losses_of_both_stages_reach_every_parameter(small):
    batch = Batch.of([sweep(1), sweep(2)])
    predictions = small(batch)
    assert predictions.refined is None
    losses = small.loss(predictions, batch.labels, torch.Generator().manual_seed(0))
    assert set(losses) == {"cls", "loc", "direction", "roi_cls", "roi_box", "roi_corner"}
    sum(losses.values()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in small.parameters())


def test_evaluation_refines_every_proposal(small):
    small.eval()
    batch = Batch.of([sweep(1), sweep(2)])
    with torch.inference_mode():
        predictions = small(batch)
        assert predictions.refined is not None
        assert len(predictions.refined.cls) == len(predictions.rois.boxes) <= 20
        detections = small.decode(predictions)
        assert set(small.loss(predictions, batch.labels)) >= {"cls", "roi_cls"}
    assert len(detections) == 2
    assert all(d.classes == ("Car",) for d in detections)


def test_a_sample_does_not_see_its_neighbours_in_the_batch(small):
    small.eval()
    with torch.inference_mode():
        both, alone = small(Batch.of([sweep(1), sweep(2)])), small(Batch.of([sweep(2)]))
    torch.testing.assert_close(both.first.cls[1:], alone.first.cls, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("training", [True, False])
def test_sweeps_without_points(small, training):
    small.train(training)
    empty = Frame(torch.zeros(0, 4), labels=Labels.empty())
    predictions = small(Batch.of([empty, empty]))
    assert len(small.decode(predictions)) == 2
    sum(small.loss(predictions, [Labels.empty()] * 2).values()).backward()
