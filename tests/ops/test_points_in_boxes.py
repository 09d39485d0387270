"""Points in boxes: against a plain loop, borders, numba against the reference."""

import math

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.geometry.boxes import corners_3d
from beambox.ops.points_in_boxes import cpu, points_in_boxes, points_in_boxes_mask, reference
from oracles import loops
from oracles.clouds import fan, random_boxes

VERSIONS = pytest.mark.parametrize("version", [reference, cpu], ids=["reference", "numba"])


@VERSIONS
@pytest.mark.parametrize(("points", "boxes"), [(0, 0), (0, 3), (5, 0), (1, 1), (200, 17)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_in_boxes_agrees_with_plain_loop(version, points, boxes, dtype):
    generator = torch.Generator().manual_seed(points + boxes)
    cloud = ((torch.rand(points, 4, generator=generator, dtype=torch.float64) - 0.5) * 8).to(dtype)
    b = random_boxes(boxes, generator, 4, dtype)
    mask = loops.points_in_boxes(cloud.numpy(), b.numpy())
    assert np.array_equal(version.points_in_boxes_mask(cloud, b).numpy(), mask)
    first = [next((m for m in range(boxes) if mask[m, n]), -1) for n in range(points)]
    assert version.points_in_boxes(cloud, b).tolist() == first


def test_numba_equals_reference_on_a_sweep():
    generator = torch.Generator().manual_seed(9)
    cloud, boxes = fan(20_000, generator), random_boxes(40, generator, 30, torch.float32)
    boxes[:, 2] = -1
    assert torch.equal(cpu.points_in_boxes(cloud, boxes), reference.points_in_boxes(cloud, boxes))
    assert torch.equal(cpu.points_in_boxes_mask(cloud, boxes), reference.points_in_boxes_mask(cloud, boxes))


@VERSIONS
def test_corners_faces_and_centers_are_inside_and_a_micrometre_further_is_not(version):
    boxes = random_boxes(20, torch.Generator().manual_seed(1), 40)
    corners = corners_3d(boxes)  # (20, 8, 3)
    faces = torch.stack([corners[:, face].mean(dim=1) for face in ([0, 1, 2, 3], [0, 1, 4, 5], [0, 3, 4, 7])], dim=1)
    for i in range(20):
        on = torch.cat((corners[i], faces[i], boxes[i : i + 1, :3]))
        assert version.points_in_boxes(on, boxes[i : i + 1]).tolist() == [0] * 12
        beyond = boxes[i, :3] + (on[:11] - boxes[i, :3]) * (1 + 1e-5)
        assert version.points_in_boxes(beyond, boxes[i : i + 1]).tolist() == [-1] * 11


@VERSIONS
def test_first_box_wins_and_turned_boxes_turn_counter_clockwise(version):
    long_box = torch.tensor([[0.0, 0, 0, 10, 1, 2, math.pi / 4]])
    boxes = torch.cat((long_box, torch.tensor([[0.0, 0, 0, 20, 20, 2, 0]]), long_box))
    points = torch.tensor([[3.0, 3, 0], [3.0, -3, 0], [0, 0, 1.5]])
    assert version.points_in_boxes(points, boxes).tolist() == [0, 1, -1]


@VERSIONS
def test_nan_points_and_flat_boxes(version):
    flat = torch.tensor([[1.0, 2, 3, 0, 0, 0, 0.3]])
    points = torch.tensor([[1.0, 2, 3], [1.0, 2, 3.001], [torch.nan, 2, 3], [1, torch.nan, 3], [1, 2, torch.nan]])
    assert version.points_in_boxes(points, flat).tolist() == [0, -1, -1, -1, -1]
    assert version.points_in_boxes(points[:1], torch.tensor([[1.0, 2, 3, -1, 1, 1, 0]])).tolist() == [-1]


def test_doors_take_non_contiguous_points_and_tell_what_is_wrong():
    points = torch.zeros(4, 6)[:, ::2]
    assert points_in_boxes(points, torch.ones(1, 7)).tolist() == [-1] * 4
    assert points_in_boxes_mask(points, torch.ones(2, 7)).shape == (2, 4)
    with pytest.raises(BeamboxError, match=r"`points` must have at least 3 columns x, y, z, got 2"):
        points_in_boxes(torch.zeros(4, 2), torch.ones(1, 7))
    with pytest.raises(BeamboxError, match=r"`boxes` must have shape \(any, 7\), got \(1, 8\)"):
        points_in_boxes_mask(torch.zeros(4, 3), torch.ones(1, 8))
