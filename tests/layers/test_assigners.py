import math

import pytest
import torch

from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS, AnchorClass, AnchorGrid
from beambox.layers.assigners import assign
from oracles.anchors import assign_one_class

REGION = VoxelGrid((0, -8, -3), (16, 8, 1), (0.5, 0.5, 4))


def random_boxes(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    low = torch.tensor([0, -8, -1.5, 0.5, 0.5, 1.2, -4.0])
    high = torch.tensor([16, 8, -0.5, 5, 2.5, 2.0, 4.0])
    return low + torch.rand(count, 7, generator=generator) * (high - low)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("count", [1, 2, 9])
def test_assign_agrees_with_plain_loops(seed: int, count: int) -> None:
    grid = AnchorGrid(KITTI_ANCHORS, REGION, stride=2)
    anchors = grid.boxes(REGION)
    boxes = random_boxes(count, seed)
    classes = torch.arange(count) % 3
    found = assign(grid, REGION, anchors, boxes, classes)
    for k, kind in enumerate(KITTI_ANCHORS):
        members = (classes == k).nonzero()[:, 0]
        own = anchors.reshape(-1, 3, 2, 7)[:, k].reshape(-1, 7)
        label = found.label.reshape(-1, 3, 2)[:, k].reshape(-1)
        gt_index = found.gt_index.reshape(-1, 3, 2)[:, k].reshape(-1)
        if len(members) == 0:
            assert (label == 0).all()
            continue
        wanted, chosen = assign_one_class(
            own.double().tolist(), boxes[members].double().tolist(), kind.matched_threshold, kind.unmatched_threshold
        )
        wanted_label = torch.tensor([k + 1 if w > 0 else w for w in wanted])
        assert (label != wanted_label).sum() <= 1  # float32 against float64 on a threshold
        positive = (label > 0) & (wanted_label > 0)
        assert (gt_index[positive] == members[torch.tensor(chosen)[positive]]).all()


def test_every_object_inside_gets_an_anchor() -> None:
    grid = AnchorGrid(KITTI_ANCHORS[:1], REGION, stride=2, centered=True)
    boxes = random_boxes(5, 3)
    found = assign(grid, REGION, grid.boxes(REGION), boxes, torch.zeros(5, dtype=torch.int64))
    assert found.positive.sum() >= 5


def test_objects_centered_outside_are_neither_target_nor_background() -> None:
    grid = AnchorGrid((AnchorClass("Car", (4.0, 2.0, 1.5), -1.7, 0.6, 0.45),), REGION, stride=2, centered=True)
    outside = torch.tensor([[16.1, 0.5, -1, 4.0, 2.0, 1.5, 0.0]])
    found = assign(grid, REGION, grid.boxes(REGION), outside, torch.zeros(1, dtype=torch.int64))
    assert not found.positive.any()
    assert (found.label == -1).any()


def test_no_objects_leave_all_anchors_background() -> None:
    grid = AnchorGrid(KITTI_ANCHORS, REGION, stride=2)
    found = assign(grid, REGION, grid.boxes(REGION), torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64))
    assert (found.label == 0).all()


def test_positions_spread_over_the_borders_as_in_the_toolbox() -> None:
    boxes = AnchorGrid(KITTI_ANCHORS[:1], REGION, stride=2).boxes(REGION).reshape(16, 16, 2, 7)
    assert boxes[0, 0, 0, 0] == 0 and boxes[0, -1, 0, 0] == 16
    assert boxes[0, 0, 0, 1] == -8 and boxes[-1, 0, 0, 1] == 8
    assert float(boxes[3, 5, 1, 6]) == pytest.approx(1.57)
    assert float(boxes[0, 0, 0, 2]) == pytest.approx(-1.0)


@pytest.mark.parametrize("centered", [True, False])
def test_a_window_has_the_anchors_of_its_place(centered: bool) -> None:
    grid = AnchorGrid(KITTI_ANCHORS, REGION, stride=2, centered=centered)
    whole = grid.boxes(REGION).reshape(16, 16, -1)
    part = grid.boxes(REGION.window((8, 4), (12, 20))).reshape(10, 6, -1)
    torch.testing.assert_close(part, whole[2:12, 4:10])


def test_nearest_rectangles_swap_at_45_degrees() -> None:
    grid = AnchorGrid(KITTI_ANCHORS[:1], REGION, stride=2, centered=True)
    along = torch.tensor([[8.5, 0.5, -1, 3.9, 1.6, 1.5, math.radians(44)]])
    across = torch.tensor([[8.5, 0.5, -1, 3.9, 1.6, 1.5, math.radians(46)]])
    zero = torch.zeros(1, dtype=torch.int64)
    first = assign(grid, REGION, grid.boxes(REGION), along, zero).positive.reshape(-1, 2).any(dim=0)
    second = assign(grid, REGION, grid.boxes(REGION), across, zero).positive.reshape(-1, 2).any(dim=0)
    assert first.tolist() == [True, False] and second.tolist() == [False, True]
