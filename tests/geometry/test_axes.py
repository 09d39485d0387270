"""Axes: what their words mean, and that boxes turn with points."""

from __future__ import annotations

import math

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.geometry.axes import Axes, turn_boxes
from beambox.geometry.boxes import corners_3d


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("x: right, y: forward", Axes("right", "forward", "up")),
        ("X=left;Y=backward", Axes("left", "backward", "up")),
        ("x: right y: down z: forward", Axes("right", "down", "forward")),
        ("x:forward,y:right", Axes("forward", "right", "down")),
    ],
)
def test_axes_parse(text: str, wanted: Axes) -> None:
    assert Axes.parse(text) == wanted
    assert Axes.parse(str(wanted)) == wanted


@pytest.mark.parametrize("text", ["", "x: right", "x: left, x: left, y: up", "x right y forward", "u: left, y: up"])
def test_axes_that_cannot_be_read(text: str) -> None:
    with pytest.raises(BeamboxError, match="axes must say where x and y lead"):
        Axes.parse(text)


def test_axes_that_lead_nowhere() -> None:
    with pytest.raises(BeamboxError, match=r'unknown direction "rigth" in axes \(did you mean "right"\?\)'):
        Axes.parse("x: rigth, y: forward")
    with pytest.raises(BeamboxError, match="three different lines"):
        Axes.parse("x: left, y: right, z: up")


@pytest.mark.parametrize("text", ["x: right, y: forward", "x: left, y: backward", "x: forward, y: right"])
def test_boxes_turn_with_their_corners(text: str) -> None:
    axes = Axes.parse(text)
    boxes = torch.tensor([[3.0, -7, 1, 4, 2, 1.5, 0.4], [0, 1, 2, 3, 1, 1, -3.0]], dtype=torch.float64)
    turned = turn_boxes(boxes, axes.matrix)
    wanted = corners_3d(boxes) @ axes.matrix.T
    actual = corners_3d(turned)
    assert torch.cdist(actual, wanted).amin(dim=2).max() < 1e-9  # the same corners, in any order
    back = turn_boxes(turned, axes.matrix.T)
    assert torch.allclose(back[:, :6], boxes[:, :6])
    assert ((back[:, 6] - boxes[:, 6]) / (2 * math.pi)).frac().abs().max() < 1e-9
