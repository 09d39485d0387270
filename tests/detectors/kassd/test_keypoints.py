import math

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.kassd.keypoints import (
    ExtraPoint,
    KeypointLayout,
    KeypointScores,
    map_coordinates,
    sample_bilinear,
)
from beambox.geometry.grid import VoxelGrid
from oracles.clouds import random_boxes

KITTI = VoxelGrid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (0.05, 0.05, 0.1))
GOLDEN_BOX = torch.tensor([[10.0, 2.0, -1.0, 4.0, 2.0, 1.5, math.radians(30)]], dtype=torch.float64)
NOWHERE = torch.zeros(1, 2, dtype=torch.float64)


def test_border_points_of_a_box_worked_out_by_hand() -> None:
    layout = KeypointLayout(m=3, n=2, d=0, e=0)
    points = layout.points(GOLDEN_BOX, NOWHERE)[0]
    wanted = [
        [11.2321, 3.8660],
        [12.2321, 2.1340],
        [10.5000, 1.1340],
        [8.7679, 0.1340],
        [7.7679, 1.8660],
        [9.5000, 2.8660],
    ]
    torch.testing.assert_close(points, torch.tensor(wanted, dtype=torch.float64), atol=1e-4, rtol=0)
    first = map_coordinates(points, KITTI, 8)[0]
    torch.testing.assert_close(first, torch.tensor([28.0803, 109.6650], dtype=torch.float64), atol=2e-4, rtol=0)


@pytest.mark.parametrize(("m", "n", "count"), [(2, 2, 4), (3, 2, 6), (6, 5, 18), (9, 7, 28), (7, 4, 18), (0, 0, 0)])
def test_border_counts_of_table_6(m: int, n: int, count: int) -> None:
    layout = KeypointLayout(m=m, n=n)
    assert layout.boundary == count
    assert len(layout.unit()) == layout.count == count + 13


@pytest.mark.parametrize(("d", "e", "count"), [(6, 3, 11), (5, 4, 13), (7, 4, 19), (1, 1, 1), (0, 0, 0)])
def test_inner_counts_of_table_6(d: int, e: int, count: int) -> None:
    assert KeypointLayout(d=d, e=e).inner == count
    assert KeypointLayout(d=d, e=e).count == 18 + count
    assert KeypointLayout(d=d, e=e, extra_point=ExtraPoint.NONE).inner == max(0, count - 1)


def lattice(layout: KeypointLayout) -> tuple[np.ndarray, np.ndarray]:
    """The points of border and inside of a unit box as complex numbers, forward real, left imaginary; no order."""
    forward, left = np.linspace(-0.5, 0.5, layout.m), np.linspace(-0.5, 0.5, layout.n)
    border = {complex(u, v) for u in forward for v in left if abs(u) == 0.5 or abs(v) == 0.5}
    inside = {
        complex(u, v)
        for u in np.linspace(-0.5, 0.5, layout.d + 1)[1:-1]
        for v in np.linspace(-0.5, 0.5, layout.e + 1)[1:-1]
    }
    return np.array(sorted(border, key=str)), np.array(sorted(inside, key=str))


@pytest.mark.parametrize("numbers", [(6, 5, 5, 4), (9, 7, 7, 4), (2, 2, 6, 3), (3, 2, 2, 2)])
def test_points_are_those_of_a_turned_lattice(numbers: tuple[int, int, int, int]) -> None:
    layout = KeypointLayout(*numbers)
    generator = torch.Generator().manual_seed(1)
    boxes = random_boxes(1000, generator)
    anchors = torch.rand(1000, 2, generator=generator, dtype=torch.float64)
    points = layout.points(boxes, anchors)
    assert torch.equal(points[:, -1], anchors)
    border, inside = lattice(layout)
    found = points.numpy() @ np.array([1, 1j])
    for i, (x, y, _, length, width, _, yaw) in enumerate(boxes.numpy()):
        turn = np.exp(1j * yaw)
        for rows, unit in ((slice(0, layout.boundary), border), (slice(layout.boundary, -1), inside)):
            wanted = complex(x, y) + turn * (unit.real * length + 1j * unit.imag * width)
            distance = np.abs(found[i, rows][:, None] - wanted)
            assert len(wanted) == distance.shape[0]
            assert distance.min(axis=0).max() < 1e-9
            assert distance.min(axis=1).max() < 1e-9


def test_points_are_numbered_as_drawn() -> None:
    box = torch.tensor([[0.0, 0, 0, 5, 4, 1, 0]], dtype=torch.float64)  # lattice cells of one metre
    points = KeypointLayout().points(box, NOWHERE)[0]
    drawn = [
        [13, 14, 15, 16, 17, 0],
        [12, 20, 23, 26, 29, 1],
        [11, 19, 22, 25, 28, 2],
        [10, 18, 21, 24, 27, 3],
        [9, 8, 7, 6, 5, 4],
    ]
    for row, numbers in enumerate(drawn):
        for column, number in enumerate(numbers):
            assert points[number].tolist() == pytest.approx([column - 2.5, 2 - row])


def test_the_extra_point_may_be_the_center() -> None:
    points = KeypointLayout(extra_point=ExtraPoint.CENTER).points(GOLDEN_BOX, NOWHERE)
    assert points[0, -1].tolist() == [10.0, 2.0]
    assert KeypointLayout(m=0, n=0, d=1, e=1).points(GOLDEN_BOX, NOWHERE + 7).tolist() == [[[7.0, 7.0]]]


def test_a_layout_that_makes_no_sense_is_refused() -> None:
    with pytest.raises(BeamboxError, match="`m` and `n` count both corners: at least 2 each, or 0 both, got 1 and 5"):
        KeypointLayout(m=1)
    with pytest.raises(BeamboxError, match="`d` and `e` must be at least 1 each, or 0 both, got 5 and 0"):
        KeypointLayout(e=0)
    with pytest.raises(BeamboxError, match="without any keypoint"):
        KeypointLayout(m=0, n=0, d=0, e=0)


def test_maps_that_hold_their_column_or_row_score_its_mean() -> None:
    kam = KeypointScores(1, KeypointLayout(), 8)
    boxes = random_boxes(50, torch.Generator().manual_seed(2))
    boxes[:, 0] += 30
    anchors = boxes[:, :2] + 0.3
    columns = torch.arange(176, dtype=torch.float64).expand(1, 31, 200, 176)
    rows = torch.arange(200, dtype=torch.float64)[:, None].expand(1, 31, 200, 176)
    at = map_coordinates(kam.layout.points(boxes, anchors), KITTI, 8)
    classes = torch.zeros(50, dtype=torch.int64)
    torch.testing.assert_close(
        kam.score(columns, KITTI, torch.tensor([0]), boxes, classes, anchors), at[..., 0].mean(dim=1)
    )
    torch.testing.assert_close(
        kam.score(rows, KITTI, torch.tensor([0]), boxes, classes, anchors), at[..., 1].mean(dim=1)
    )


def test_each_point_reads_its_own_map_of_its_class_and_sample() -> None:
    kam = KeypointScores(1, KeypointLayout(m=2, n=2, d=0, e=0), 8, num_classes=2)
    maps = torch.arange(16.0).reshape(2, 8, 1, 1).expand(2, 8, 200, 176)
    boxes = torch.tensor([[10.0, 0, 0, 4, 2, 1, 0.4]]).expand(2, 7)
    score = kam.score(maps, KITTI, torch.tensor([1]), boxes, torch.tensor([0, 1]), boxes[:, :2])
    assert score.tolist() == pytest.approx([(8 + 9 + 10 + 11) / 4, (12 + 13 + 14 + 15) / 4])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sampling_agrees_with_torch_inside_at_the_border_and_outside(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(3)
    maps = torch.randn(1, 4, 7, 9, generator=generator, dtype=dtype)
    at = torch.rand(4, 300, 2, generator=generator, dtype=dtype) * 14 - 3
    whole = torch.tensor([[0, 0], [8, 6], [-1, 3], [9, 3], [8, 7], [-0.5, -0.5], [8.5, 6.5]], dtype=dtype)
    at = torch.cat((at, whole.expand(4, -1, 2)), dim=1)
    channel = torch.arange(4)[:, None].expand(4, at.shape[1])
    ours = sample_bilinear(maps, torch.zeros_like(channel), channel, at)
    scaled = 2 * at / torch.tensor([8, 6], dtype=dtype) - 1
    theirs = torch.nn.functional.grid_sample(maps[0][:, None], scaled[:, :, None], align_corners=True)[:, 0, :, 0]
    torch.testing.assert_close(ours, theirs, atol=1e-5 if dtype is torch.float32 else 1e-12, rtol=1e-5)


def test_far_infinite_and_no_positions() -> None:
    maps = torch.ones(1, 1, 3, 3)
    at = torch.tensor([[1e30, 0.0], [-math.inf, math.inf], [1.0, 1.0]])
    zero = torch.zeros(3, dtype=torch.int64)
    assert sample_bilinear(maps, zero, zero, at).tolist() == [0.0, 0.0, 1.0]
    assert sample_bilinear(maps, zero[:0], zero[:0], at[:0]).shape == (0,)


def test_gradients_with_respect_to_maps_and_boxes() -> None:
    layout = KeypointLayout(m=3, n=2, d=2, e=2)
    kam = KeypointScores(1, layout, 8)
    grid = VoxelGrid((0.0, -2.4, -3.0), (4.8, 2.4, 1.0), (0.1, 0.1, 0.1))
    generator = torch.Generator().manual_seed(4)
    maps = torch.randn(1, layout.count, 6, 6, generator=generator, dtype=torch.float64).requires_grad_()
    boxes = torch.tensor([[2.03, 0.21, -1, 1.9, 1.1, 1.5, 0.4], [4.37, 2.1, -1, 2, 1.1, 1.5, -2]], dtype=torch.float64)
    boxes = boxes.requires_grad_()
    classes, anchors = torch.zeros(2, dtype=torch.int64), torch.tensor([[2.11, 0.05], [4.3, 2.2]], dtype=torch.float64)

    def score(maps: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
        return kam.score(maps, grid, torch.tensor([0]), boxes, classes, anchors)

    assert torch.autograd.gradcheck(score, (maps, boxes), atol=1e-6)
    score(maps, boxes).sum().backward()
    assert maps.grad is not None and bool((maps.grad.flatten(2).abs().sum(dim=2) > 0).all()), "every map is read"


def test_fresh_maps_start_at_the_prior() -> None:
    torch.manual_seed(0)
    kam = KeypointScores(8, KeypointLayout(), 8, num_classes=3, width=16)
    maps = kam(torch.zeros(1, 8, 5, 5))
    assert maps.shape == (1, 93, 5, 5)
    torch.testing.assert_close(torch.sigmoid(maps), torch.full_like(maps, 0.01), atol=1e-6, rtol=1e-4)
