import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from beambox.checks import BeamboxError
from beambox.geometry import Calibration, corners_3d

# A camera 0.27 m ahead of the LiDAR and 0.08 m below it, slightly turned, as KITTI's.
TURN = 0.01
CALIBRATION = Calibration(
    p2=torch.tensor([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.0027]], dtype=torch.float64),
    r0=torch.tensor(
        [[math.cos(TURN), math.sin(TURN), 0], [-math.sin(TURN), math.cos(TURN), 0], [0, 0, 1]], dtype=torch.float64
    ),
    velo_to_cam=torch.tensor([[0, -1, 0, 0.0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]], dtype=torch.float64),
)
POINTS = arrays("float64", (6, 3), elements=st.floats(-60, 60)).map(torch.from_numpy)


@given(POINTS)
def test_lidar_and_camera_frames_are_inverse(xyz: torch.Tensor) -> None:
    there = CALIBRATION.lidar_to_rect(xyz)
    torch.testing.assert_close(CALIBRATION.rect_to_lidar(there), xyz, atol=1e-9, rtol=1e-9)


@given(st.floats(3, 60), st.floats(-30, 30), st.floats(-3.2, 3.1))
def test_boxes_come_back_from_the_camera(x: float, y: float, yaw: float) -> None:
    box = torch.tensor([[x, y, -0.9, 4.1, 1.7, 1.5, yaw]], dtype=torch.float64)
    camera = CALIBRATION.to_camera(box)
    again = CALIBRATION.from_camera(camera.location, camera.size, camera.rotation_y)
    torch.testing.assert_close(again[:, :6], box[:, :6], atol=1e-9, rtol=1e-9)
    assert math.isclose(math.cos(float(again[0, 6]) - yaw), 1, abs_tol=1e-9)
    assert -math.pi <= float(camera.alpha) < math.pi


def test_a_car_straight_ahead_seen_from_behind() -> None:
    level = Calibration(CALIBRATION.p2, torch.eye(3), CALIBRATION.velo_to_cam)
    camera = level.to_camera(torch.tensor([[20.0, 0, -0.95, 4, 1.6, 1.5, 0]]), (1242, 375))
    torch.testing.assert_close(camera.location[0], torch.tensor([0, 1.62, 19.73], dtype=torch.float64))
    assert float(camera.rotation_y) == pytest.approx(-math.pi / 2)
    assert float(camera.alpha) == pytest.approx(-math.pi / 2)
    left, top, right, bottom = camera.image[0].tolist()
    assert left < 609 < right and 150 < top < bottom < 375


def test_the_image_box_bounds_the_projected_corners() -> None:
    box = torch.tensor([[15.0, 3, -1, 4, 1.6, 1.5, 0.7]], dtype=torch.float64)
    pixels, _ = CALIBRATION.rect_to_image(CALIBRATION.lidar_to_rect(corners_3d(box)[0]))
    image = CALIBRATION.to_camera(box).image[0]
    torch.testing.assert_close(image, torch.cat((pixels.amin(dim=0), pixels.amax(dim=0))))


def test_the_view_keeps_what_projects_into_the_image() -> None:
    points = torch.tensor([[20.0, 0, 0, 0], [-20, 0, 0, 0], [5, 30, 0, 0], [20, 0, 30, 0]])
    assert CALIBRATION.in_view(points, (1242, 375)).tolist() == [True, False, False, False]


def test_no_boxes_give_no_boxes() -> None:
    camera = CALIBRATION.to_camera(torch.zeros(0, 7), (1242, 375))
    assert camera.image.shape == (0, 4) and camera.location.shape == (0, 3)


def test_matrices_of_another_shape_are_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`r0` must have shape \(3, 3\), got \(4, 4\)"):
        Calibration(CALIBRATION.p2, torch.eye(4), CALIBRATION.velo_to_cam)
