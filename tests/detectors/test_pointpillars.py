import pytest
import torch

from beambox.detectors.pointpillars import PointPillarsConfig, pointpillars
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.structures import Batch
from oracles.small_detectors import POINTPILLARS, build_small, car_frame


def test_published_network_has_the_published_size() -> None:
    assert sum(p.numel() for p in pointpillars().parameters()) == 4_834_888
    car = pointpillars(PointPillarsConfig(anchors=KITTI_ANCHORS[:1]))
    assert sum(p.numel() for p in car.parameters()) == pytest.approx(4.815e6, rel=0.01)


def test_a_window_agrees_with_the_whole_far_from_its_border() -> None:
    model = build_small("pointpillars").eval()
    batch = Batch.of([car_frame(2, [10, 0, -1, 4.0, 1.7, 1.5, 0.0], ground=1500, reach=20.0)])
    whole = model(batch).cls.reshape(1, 32, 32, -1)
    window = POINTPILLARS.grid.window((0, 0), (64, 48))
    part = model(batch, window).cls.reshape(1, 24, 32, -1)
    torch.testing.assert_close(part[:, :6], whole[:, :6], atol=1e-4, rtol=1e-3)
