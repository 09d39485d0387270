import math

import pytest
import torch

from beambox.detectors.pointpillars import PointPillarsConfig, pointpillars
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.structures import Batch, Frame, Labels

SMALL = PointPillarsConfig(
    anchors=KITTI_ANCHORS[:1],
    grid=VoxelGrid((0, -10.24, -3), (20.48, 10.24, 1), (0.32, 0.32, 4)),
    pillar_channels=8,
    depths=(1, 1, 1),
    widths=(8, 8, 16),
    up_widths=(8, 8, 8),
    centred_anchors=True,
)


def car_frame(seed: int, *boxes: list[float]) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    ground = torch.rand(1500, 4, generator=generator) * torch.tensor([20.0, 20.0, 0.05, 0.3])
    ground -= torch.tensor([0.0, 10.0, 1.75, 0.0])
    clouds = [ground]
    for x, y, z, length, width, height, yaw in boxes:
        local = (torch.rand(300, 3, generator=generator) - 0.5) * torch.tensor([length, width, height])
        face = torch.randint(0, 2, (300,), generator=generator)
        local[face == 0, 0] = -length / 2
        local[face == 1, 1] = -width / 2
        cos, sin = math.cos(yaw), math.sin(yaw)
        xyz = torch.stack(
            (x + cos * local[:, 0] - sin * local[:, 1], y + sin * local[:, 0] + cos * local[:, 1], z + local[:, 2]), 1
        )
        clouds.append(torch.cat((xyz, torch.full((300, 1), 0.5)), dim=1))
    labels = Labels(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 7), ("Car",) * len(boxes))
    return Frame(torch.cat(clouds), id=str(seed), labels=labels)


def test_published_network_has_the_published_size() -> None:
    assert sum(p.numel() for p in pointpillars().parameters()) == 4_834_888
    car = pointpillars(PointPillarsConfig(anchors=KITTI_ANCHORS[:1]))
    assert sum(p.numel() for p in car.parameters()) == pytest.approx(4.815e6, rel=0.01)


def test_overfits_two_cars_and_finds_them() -> None:
    torch.manual_seed(0)
    frame = car_frame(1, [6, 2, -1, 4.0, 1.7, 1.5, 0.4], [13, -4, -1, 3.7, 1.6, 1.5, -2.0])
    model = pointpillars(SMALL).train()
    batch = Batch.of([frame])
    assert batch.labels is not None
    optimiser = torch.optim.Adam(model.parameters(), lr=0.01)
    losses = []
    for _ in range(80):
        optimiser.zero_grad()
        total = torch.stack(list(model.loss(model(batch), batch.labels).values())).sum()
        total.backward()
        optimiser.step()
        losses.append(float(total.detach()))
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(batch))
    best = found[:2]
    order = best.boxes[:, 0].argsort()
    torch.testing.assert_close(best.boxes[order][:, :2].detach(), frame.labels.boxes[:, :2], atol=0.3, rtol=0)
    heading = best.boxes[order][:, 6].detach() - frame.labels.boxes[:, 6]
    assert bool((torch.cos(heading) > 0.9).all())


def test_a_window_agrees_with_the_whole_far_from_its_border() -> None:
    torch.manual_seed(0)
    model = pointpillars(SMALL).eval()
    batch = Batch.of([car_frame(2, [10, 0, -1, 4.0, 1.7, 1.5, 0.0])])
    whole = model(batch).cls.reshape(1, 32, 32, -1)
    window = SMALL.grid.window((0, 0), (64, 48))
    part = model(batch, window).cls.reshape(1, 24, 32, -1)
    torch.testing.assert_close(part[:, :6], whole[:, :6], atol=1e-4, rtol=1e-3)


def test_samples_of_a_batch_do_not_touch_each_other() -> None:
    torch.manual_seed(0)
    model = pointpillars(SMALL).eval()
    one, two = car_frame(3, [10, 0, -1, 4.0, 1.7, 1.5, 0.0]), car_frame(4)
    alone = model(Batch.of([two]))
    joined = model(Batch.of([one, two]))
    torch.testing.assert_close(joined.cls[1], alone.cls[0], atol=1e-5, rtol=1e-4)


def test_an_empty_sweep_gives_predictions_a_loss_and_no_error() -> None:
    model = pointpillars(SMALL)
    batch = Batch.of([Frame(torch.zeros(0, 4), labels=Labels.empty())])
    assert batch.labels is not None
    for mode in (True, False):
        model.train(mode)
        losses = model.loss(model(batch), batch.labels)
        assert all(torch.isfinite(v) for v in losses.values())
    assert len(model.decode(model(batch))) == 1


def test_every_parameter_receives_a_gradient() -> None:
    torch.manual_seed(0)
    model = pointpillars(SMALL)
    batch = Batch.of([car_frame(5, [6, 2, -1, 4.0, 1.7, 1.5, 0.4])])
    assert batch.labels is not None
    torch.stack(list(model.loss(model(batch), batch.labels).values())).sum().backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.any())] == []
