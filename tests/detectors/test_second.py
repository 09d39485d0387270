"""SECOND: sizes and configurations."""

from __future__ import annotations

import pytest

from beambox.checks import BeamboxError
from beambox.detectors.second import KITTI_CAR, ONCE, SECONDConfig, second


def test_parameters_of_the_published_network():
    assert sum(p.numel() for p in second().parameters()) == pytest.approx(5.33e6, rel=0.002)
    assert sum(p.numel() for p in second().encoder.parameters()) == pytest.approx(0.712e6, rel=0.002)


def test_classes_of_the_configurations():
    assert SECONDConfig().classes == ("Car", "Pedestrian", "Cyclist")
    assert KITTI_CAR.classes == ("Car",)
    assert ONCE.classes == ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")
    with pytest.raises(BeamboxError, match="at least one class"):
        SECONDConfig(anchors=())
