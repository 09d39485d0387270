"""Sweeps that lack a column which the network reads are refused in one line, before anything runs."""

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build
from beambox.infer.predictor import Detector
from beambox.structures import Frame, expect_columns


def test_a_missing_column_is_named() -> None:
    expect_columns(Frame(torch.zeros(3, 5), id="a"), 4)
    expect_columns(Frame(torch.zeros(3, 4), id="a"), 4)
    with pytest.raises(BeamboxError, match=r"reads 5 columns of each point, and sweep a has 4: name all"):
        expect_columns(Frame(torch.zeros(3, 4), id="a"), 5)


def test_a_detector_of_five_columns_refuses_four() -> None:
    options = {
        "num_point_features": 5,
        "voxel_channels": 8,
        "widths": [8, 8, 8],
        "up_widths": [8, 8, 8],
        "depths": [1, 1, 1],
    }
    detector = Detector(build("pointpillars", options))
    points = torch.rand(50, 4) * torch.tensor([40.0, 20.0, 1.0, 1.0])
    with pytest.raises(BeamboxError, match="sweep four has 4"):
        detector(Frame(points, id="four"))
