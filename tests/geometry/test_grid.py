import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from beambox.checks import BeamboxError
from beambox.geometry.grid import VoxelGrid

KITTI = VoxelGrid((0, -40, -3), (70.4, 40, 1), (0.05, 0.05, 0.1))


@pytest.mark.parametrize(
    ("minimum", "maximum", "cell", "size"),
    [
        ((0, -40, -3), (70.4, 40, 1), (0.05, 0.05, 0.1), (1408, 1600, 40)),
        ((0, -40, -3), (70.4, 40, 3), (0.1, 0.1, 0.15), (704, 800, 40)),
        ((0, -40, -3), (70.4, 40, 1), (0.1, 0.1, 0.15), (704, 800, 27)),
        ((-75.2, -75.2, -5), (75.2, 75.2, 3), (0.1, 0.1, 0.2), (1504, 1504, 40)),
        ((0, -39.68, -3), (69.12, 39.68, 1), (0.16, 0.16, 1), (432, 496, 4)),
    ],
)
def test_published_grids_have_the_published_size(minimum, maximum, cell, size) -> None:
    assert VoxelGrid(minimum, maximum, cell).size == size


def test_border_points_are_inside_below_and_outside_above() -> None:
    grid = VoxelGrid((0, 0, 0), (2, 2, 2), (1, 1, 1))
    points = torch.tensor([[0.0, 0, 0], [2, 0, 0], [1, 1, 1], [-1e-6, 0, 0], [float("nan"), 0, 0]])
    index, inside = grid.index(points)
    assert inside.tolist() == [True, False, True, False, False]
    assert index[2].tolist() == [1, 1, 1]


@given(st.integers(0, 39), st.integers(0, 1599), st.integers(0, 1407))
def test_the_center_of_a_cell_lies_in_it(z: int, y: int, x: int) -> None:
    cell = torch.tensor([[z, y, x]])
    index, inside = KITTI.index(KITTI.center(cell))
    assert bool(inside) and torch.equal(index, cell)


def test_a_window_keeps_cells_and_height() -> None:
    window = KITTI.window((160, 320), (400, 80))
    assert window.size == (400, 80, 40)
    assert window.minimum == pytest.approx((8.0, -24.0, -3.0))


def test_an_upside_down_region_is_refused() -> None:
    with pytest.raises(BeamboxError, match=r"minimum < maximum.*on y"):
        VoxelGrid((0, 1, 0), (1, 0, 1), (1, 1, 1))
