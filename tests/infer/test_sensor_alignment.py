"""Another sensor's axes and height: what goes in turned comes out where it was."""

from __future__ import annotations

import math
from itertools import permutations, product

import pytest
import torch

from beambox.geometry import corners_bev
from beambox.geometry.axes import Axes
from beambox.infer.sensor_alignment import SensorAlignment
from beambox.structures import Detections, Frame

PAIRS = (("forward", "backward"), ("left", "right"), ("up", "down"))
ALL = [Axes(*words) for order in permutations(PAIRS) for words in product(*order)]
LEVEL = [axes for axes in ALL if axes.vertical_z]


def detections(boxes: torch.Tensor) -> Detections:
    return Detections(boxes, torch.ones(len(boxes)), torch.zeros(len(boxes), dtype=torch.int64), ("Car",))


def test_there_are_48_frames_half_of_them_right_handed() -> None:
    assert len(ALL) == 48
    assert sum(axes.right_handed for axes in ALL) == 24


@pytest.mark.parametrize("axes", ALL, ids=str)
def test_matrix_is_orthonormal_and_says_where_the_axes_lead(axes: Axes) -> None:
    assert torch.equal(axes.matrix @ axes.matrix.T, torch.eye(3, dtype=torch.float64))
    forward = axes.matrix @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    wanted = {"forward": (1, 0, 0), "backward": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0)}
    wanted |= {"up": (0, 0, 1), "down": (0, 0, -1)}
    assert tuple(forward.tolist()) == wanted[axes.x]


@pytest.mark.parametrize("axes", ALL, ids=str)
def test_printed_axes_are_read_back(axes: Axes) -> None:
    assert Axes.parse(str(axes)) == axes


@pytest.mark.parametrize("axes", LEVEL, ids=str)
def test_boxes_stay_around_their_points(axes: Axes) -> None:
    """A box found around turned points, carried back, has its corners at the given points."""
    generator = torch.Generator().manual_seed(3)
    boxes = torch.rand(5, 7, generator=generator, dtype=torch.float64) * 6 + 0.5
    here = SensorAlignment(axes, z_offset=0.4, slope=(0.02, -0.05))
    given_corners = corners_bev(boxes)  # (5, 4, 2), in the given frame
    points = torch.cat((given_corners.reshape(-1, 2), torch.zeros(20, 2, dtype=torch.float64)), dim=1)
    seen = here.apply(Frame(points.float())).points[:, :2].reshape(5, 4, 2)
    found = corners_bev(here.from_sensor(boxes))
    for a, b in zip(seen.double(), found):  # the order of corners turns round in a mirrored frame
        assert torch.cdist(a, b).amin(dim=1).max() < 1e-4
    back = here.to_sensor(detections(here.from_sensor(boxes)))
    assert torch.allclose(back.boxes[:, :6], boxes[:, :6])
    turn = (back.boxes[:, 6] - boxes[:, 6] + math.pi) % (2 * math.pi) - math.pi
    assert turn.abs().max() < 1e-9


def test_height_moves_points_up_and_boxes_back_down() -> None:
    alignment = SensorAlignment(z_offset=0.5)
    frame = Frame(torch.tensor([[1.0, 2.0, -2.23, 0.5]]))
    assert alignment.apply(frame).points[0, 2] == pytest.approx(-1.73)
    assert frame.points[0, 2] == pytest.approx(-2.23), "the given points are not changed"
    assert alignment.to_sensor(detections(torch.ones(1, 7))).boxes[0, 2] == pytest.approx(0.5)


def test_boxes_of_points_with_a_lying_z_stay_in_the_usual_frame() -> None:
    camera = SensorAlignment(Axes("right", "down", "forward"))
    boxes = torch.tensor([[10.0, 2.0, -1.0, 4.0, 1.6, 1.5, 0.3]])
    assert torch.equal(camera.to_sensor(detections(boxes)).boxes, boxes)


def test_no_correction_is_no_change() -> None:
    frame = Frame(torch.rand(3, 4))
    assert SensorAlignment().apply(frame) is frame


def test_a_slope_is_taken_from_points_and_given_back_to_boxes() -> None:
    x, y = torch.meshgrid(torch.arange(-20.0, 21, 5), torch.arange(-20.0, 21, 5), indexing="ij")
    ground = torch.stack((x, y, 0.02 * x - 0.03 * y - 2, torch.zeros_like(x)), dim=2).reshape(-1, 4)
    here = SensorAlignment(z_offset=0.27, slope=(0.02, -0.03))
    assert here.apply(Frame(ground)).points[:, 2].tolist() == pytest.approx([-1.73] * 81, abs=1e-5)
    boxes = torch.tensor([[10.0, -10.0, -0.75, 4.0, 1.8, 1.5, 0.3]], dtype=torch.float64)
    seen = here.from_sensor(boxes)
    assert seen[0, 2].item() == pytest.approx(-0.75 + 0.27 - 0.2 - 0.3)
    assert torch.allclose(here.to_sensor(detections(seen)).boxes, boxes)
