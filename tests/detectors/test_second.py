"""SECOND: sizes, losses, decoding, gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.second import KITTI_CAR, ONCE, Second, SecondConfig, second
from beambox.geometry.grid import VoxelGrid
from beambox.structures import Batch, Frame, Labels

SMALL = replace(
    KITTI_CAR,
    grid=VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 1.0), (0.1, 0.1, 0.1)),
    encoder_widths=(4, 4, 8, 8),
    encoder_out=8,
    depths=(1, 1),
    widths=(8, 8),
    up_widths=(8, 8),
)


def sweep(seed: int, points: int = 500) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.rand((points, 4), generator=generator) * torch.tensor([12.0, 12.0, 3.5, 1.0])
    return Frame(
        xyz - torch.tensor([0.0, 6.0, 3.0, 0.0]),
        labels=Labels(torch.tensor([[6.0, 0, -1, 4, 1.6, 1.5, 0.3]]), ("Car",)),
    )


@pytest.fixture
def small() -> Second:
    torch.manual_seed(0)
    return second(SMALL)


def test_parameters_of_the_published_network():
    assert sum(p.numel() for p in second().parameters()) == pytest.approx(5.33e6, rel=0.002)
    assert sum(p.numel() for p in second().encoder.parameters()) == pytest.approx(0.712e6, rel=0.002)


def test_classes_of_the_configurations():
    assert SecondConfig().classes == ("Car", "Pedestrian", "Cyclist")
    assert KITTI_CAR.classes == ("Car",)
    assert ONCE.classes == ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")
    with pytest.raises(BeamboxError, match="at least one class"):
        SecondConfig(anchors=())


def test_predictions_cover_the_map_and_losses_reach_every_parameter(small):
    batch = Batch.of([sweep(1), sweep(2)])
    predictions = small(batch)
    assert predictions.cls.shape == (2, 16 * 16 * 2, 1)
    losses = small.loss(predictions, batch.labels)
    assert set(losses) == {"cls", "loc", "direction"}
    sum(losses.values()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in small.parameters())


def test_a_sample_does_not_see_its_neighbours_in_the_batch(small):
    small.eval()
    with torch.inference_mode():
        both = small(Batch.of([sweep(1), sweep(2)]))
        alone = small(Batch.of([sweep(2)]))
    torch.testing.assert_close(both.cls[1:], alone.cls, rtol=1e-4, atol=1e-5)


def test_another_region_of_the_same_cells(small):
    small.eval()
    window = SMALL.grid.window((32, 32), (64, 64))
    with torch.inference_mode():
        predictions = small(Batch.of([sweep(1)]), window)
    assert predictions.cls.shape[1] == 8 * 8 * 2
    assert predictions.grid == window


@pytest.mark.parametrize("training", [True, False])
def test_sweeps_without_points(small, training):
    small.train(training)
    empty = Frame(torch.zeros(0, 4), labels=Labels.empty())
    predictions = small(Batch.of([empty, empty]))
    assert predictions.cls.isfinite().all()
    assert len(small.decode(predictions)) == 2
    sum(small.loss(predictions, [Labels.empty()] * 2).values()).backward()
