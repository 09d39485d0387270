"""Voxel R-CNN: sizes, configurations, refinement."""

from __future__ import annotations

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.voxel_rcnn import KITTI, ONCE, VoxelRCNNConfig, voxel_rcnn
from beambox.structures import Batch
from oracles.small_detectors import CAR, TWO_STAGES, build_small, car_frame


def test_parameters_of_the_published_network():
    assert sum(p.numel() for p in voxel_rcnn().parameters()) == pytest.approx(7.587e6, rel=0.001)


def test_classes_of_the_configurations():
    assert VoxelRCNNConfig().classes == ("Car",)
    assert KITTI.classes == ("Car", "Pedestrian", "Cyclist")
    assert ONCE.classes == ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")
    with pytest.raises(BeamboxError, match="levels of stride 2, 4 or 8"):
        VoxelRCNNConfig(pooling=())


def test_evaluation_refines_every_proposal():
    small = build_small("voxel_rcnn")
    batch = Batch.of([car_frame(1, CAR), car_frame(2)])
    small.eval()
    with torch.inference_mode():
        predictions = small(batch)
        assert len(predictions.refined.cls) == len(predictions.rois.boxes) <= 20
        detections = small.decode(predictions)
        to_learn = small(batch, labels=batch.labels)
        assert len(to_learn.refined.cls) == 2 * TWO_STAGES["sampling"].rois_per_frame, "those drawn to learn from"
        assert set(small.loss(to_learn, batch.labels)) >= {"cls", "roi_cls"}
    assert len(detections) == 2
    assert all(d.classes == ("Car",) for d in detections)
