import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from beambox.geometry import boxes as geometry
from beambox.geometry.boxes import corners_3d, corners_bev, local_to_world, world_to_local, wrap_angle

FLOAT = {"width": 64, "allow_nan": False}
BOXES = st.integers(0, 5).flatmap(
    lambda n: arrays("float64", (n, 7), elements=st.floats(-50, 50, **FLOAT)).map(
        lambda a: (
            torch.from_numpy(a) * torch.tensor([1, 1, 1, 0, 0, 0, 0.1]) + torch.tensor([0, 0, 0, 4.0, 1.7, 1.5, 0])
        )
    )
)


@given(st.floats(-1e3, 1e3))
def test_wrapping_keeps_the_direction_and_lands_in_the_half_open_interval(angle: float) -> None:
    wrapped = float(wrap_angle(torch.tensor(angle, dtype=torch.float64)))
    assert -math.pi <= wrapped < math.pi + 1e-12
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@given(BOXES)
def test_flipping_twice_changes_nothing(boxes: torch.Tensor) -> None:
    for flip in (geometry.flip_boxes_x, geometry.flip_boxes_y):
        again = flip(flip(boxes))
        torch.testing.assert_close(again[:, :6], boxes[:, :6])
        assert bool((torch.cos(again[:, 6] - boxes[:, 6]) > 1 - 1e-9).all())


@given(BOXES)
def test_flipping_boxes_flips_their_corners(boxes: torch.Tensor) -> None:
    mirror = torch.tensor([1.0, -1.0], dtype=torch.float64)
    wanted = corners_bev(boxes) * mirror
    found = corners_bev(geometry.flip_boxes_x(boxes))
    for row in range(len(boxes)):  # the same four corners, in another order
        distance = torch.cdist(found[row], wanted[row])
        assert float(distance.amin(dim=1).amax()) < 1e-6


@given(BOXES, st.floats(-7, 7))
def test_rotating_back_changes_nothing(boxes: torch.Tensor, angle: float) -> None:
    again = geometry.rotate_boxes(geometry.rotate_boxes(boxes, angle), -angle)
    torch.testing.assert_close(again[:, :6], boxes[:, :6], atol=1e-9, rtol=1e-9)
    assert bool((torch.cos(again[:, 6] - boxes[:, 6]) > 1 - 1e-9).all())


@given(BOXES, st.floats(-7, 7))
def test_rotating_boxes_rotates_their_corners(boxes: torch.Tensor, angle: float) -> None:
    turned = geometry.rotate_z(corners_3d(boxes), torch.tensor(angle, dtype=torch.float64))
    torch.testing.assert_close(corners_3d(geometry.rotate_boxes(boxes, angle)), turned, atol=1e-9, rtol=1e-9)


@given(BOXES)
def test_local_frames_are_inverse(boxes: torch.Tensor) -> None:
    local = torch.linspace(-3, 3, 15, dtype=torch.float64).reshape(1, 5, 3).expand(len(boxes), 5, 3)
    torch.testing.assert_close(world_to_local(local_to_world(local, boxes), boxes), local, atol=1e-9, rtol=1e-9)


def test_corners_of_a_quarter_turned_box() -> None:
    box = torch.tensor([[10.0, 5.0, 1.0, 4.0, 2.0, 1.5, math.pi / 2]])
    corners = corners_bev(box)[0]
    torch.testing.assert_close(corners, torch.tensor([[9.0, 7], [9, 3], [11, 3], [11, 7]]))
    torch.testing.assert_close(corners_3d(box)[0, :, 2], torch.tensor([0.25] * 4 + [1.75] * 4))


@pytest.mark.parametrize(
    ("degrees", "swapped"), [(0, False), (44, False), (46, True), (90, True), (134, True), (136, False), (-46, True)]
)
def test_nearest_rectangle_swaps_beyond_45_degrees(degrees: float, swapped: bool) -> None:
    box = torch.tensor([[0.0, 0, 0, 4, 2, 1, math.radians(degrees)]])
    x0, y0, x1, y1 = geometry.axis_aligned_bev(box)[0].tolist()
    assert (x1 - x0, y1 - y0) == ((2, 4) if swapped else (4, 2))
