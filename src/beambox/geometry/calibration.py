"""KITTI's calibration: LiDAR, rectified camera and image, and boxes between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from beambox.checks import expect_shape
from beambox.geometry.boxes import corners_3d, wrap_angle

__all__ = ["Calibration", "CameraBoxes"]


@dataclass(frozen=True)
class CameraBoxes:
    """Boxes as KITTI's label files hold them, all of length N."""

    location: Tensor
    """``(N, 3)`` bottom centre in the rectified camera frame (x right, y down, z forward), metres."""
    size: Tensor
    """``(N, 3)`` height, width, length, metres."""
    rotation_y: Tensor
    """``(N,)`` rotation about the camera's y axis, radians in [-pi, pi)."""
    alpha: Tensor
    """``(N,)`` observation angle, radians in [-pi, pi)."""
    image: Tensor
    """``(N, 4)`` left, top, right, bottom of the projected box, pixels."""


@dataclass(frozen=True)
class Calibration:
    """Transformations of one KITTI frame, float64.

    Frames: LiDAR (x forward, y left, z up), rect (x right, y down, z forward), image (u right, v down, pixels).
    """

    p2: Tensor
    """``(3, 4)`` projection from rect to camera 2's image."""
    r0: Tensor
    """``(3, 3)`` rectifying rotation."""
    velo_to_cam: Tensor
    """``(3, 4)`` from the LiDAR to the unrectified camera 0."""

    def __post_init__(self) -> None:
        expect_shape("p2", self.p2, (3, 4))
        expect_shape("r0", self.r0, (3, 3))
        expect_shape("velo_to_cam", self.velo_to_cam, (3, 4))
        for name in ("p2", "r0", "velo_to_cam"):
            object.__setattr__(self, name, getattr(self, name).double())

    @property
    def lidar_to_rect_matrix(self) -> Tensor:
        """``(4, 4)`` homogeneous transformation from the LiDAR to rect: R0 * Tr."""
        transform = torch.eye(4, dtype=torch.float64)
        transform[:3] = self.velo_to_cam
        rectify = torch.eye(4, dtype=torch.float64)
        rectify[:3, :3] = self.r0
        return rectify @ transform

    def lidar_to_rect(self, xyz: Tensor) -> Tensor:
        """Carry ``(N, 3)`` LiDAR points to rect, float64."""
        matrix = self.lidar_to_rect_matrix
        return xyz.double() @ matrix[:3, :3].T + matrix[:3, 3]

    def rect_to_lidar(self, xyz: Tensor) -> Tensor:
        """Carry ``(N, 3)`` rect points to the LiDAR frame, float64."""
        matrix = torch.linalg.inv(self.lidar_to_rect_matrix)
        return xyz.double() @ matrix[:3, :3].T + matrix[:3, 3]

    def rect_to_image(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Project ``(N, 3)`` rect points: ``(N, 2)`` pixels u, v and ``(N,)`` depth in metres.

        u and v are divided by rect's z, as the public toolbox does.
        """
        projected = xyz.double() @ self.p2[:, :3].T + self.p2[:, 3]  # (N, 3)
        return projected[:, :2] / xyz[:, 2:3].double(), projected[:, 2] - self.p2[2, 3]

    def in_view(self, points: Tensor, image_size: tuple[int, int]) -> Tensor:
        """Tell which ``(N, 3 or more)`` LiDAR points fall into an image of (width, height): ``(N,)`` bool.

        The test is 0 <= u < width, 0 <= v < height, depth >= 0 with :meth:`rect_to_image`'s pixels; here it is
        multiplied by the depth and done in one product, since it runs over whole sweeps.
        """
        matrix = self.lidar_to_rect_matrix
        rows = torch.cat((self.p2[:2] @ matrix, matrix[2:3]))  # (3, 4): u * depth, v * depth, depth
        across, down, depth = torch.addmm(rows[:, 3:], rows[:, :3], points[:, :3].double().T)  # (N,) each
        width, height = image_size
        return (depth >= 0) & (across >= 0) & (across < width * depth) & (down >= 0) & (down < height * depth)

    def from_camera(self, location: Tensor, size: Tensor, rotation_y: Tensor) -> Tensor:
        """Turn label boxes into LiDAR boxes.

        Args:
            location: ``(N, 3)`` bottom centre in rect, metres.
            size: ``(N, 3)`` height, width, length, metres.
            rotation_y: ``(N,)`` radians.

        Returns:
            ``(N, 7)`` float64 boxes in the LiDAR frame.
        """
        center = self.rect_to_lidar(location)
        height, width, length = size.double().unbind(dim=1)
        center[:, 2] += height / 2
        yaw = wrap_angle(-(rotation_y.double() + math.pi / 2))
        return torch.cat((center, torch.stack((length, width, height, yaw), dim=1)), dim=1)

    def to_camera(self, boxes: Tensor, image_size: tuple[int, int] | None = None) -> CameraBoxes:
        """Turn LiDAR boxes into label boxes; inverse of :meth:`from_camera`.

        Args:
            boxes: ``(N, 7)``.
            image_size: (width, height) in pixels; where given, the image boxes are clipped to it.
        """
        boxes = boxes.double()
        bottom = boxes[:, :3].clone()
        bottom[:, 2] -= boxes[:, 5] / 2
        location = self.lidar_to_rect(bottom)
        rotation_y = wrap_angle(-boxes[:, 6] - math.pi / 2)
        alpha = wrap_angle(rotation_y - torch.atan2(location[:, 0], location[:, 2]))
        size = boxes[:, [5, 4, 3]]
        return CameraBoxes(location, size, rotation_y, alpha, self._image_boxes(boxes, image_size))

    def _image_boxes(self, boxes: Tensor, image_size: tuple[int, int] | None) -> Tensor:
        corners = self.lidar_to_rect(corners_3d(boxes).reshape(-1, 3))  # (N * 8, 3)
        # Corners behind the camera would project mirrored; a centimetre in front keeps their side.
        corners[:, 2] = corners[:, 2].clamp(min=0.01)
        pixels = self.rect_to_image(corners)[0].reshape(-1, 8, 2)
        low, high = (pixels.amin(dim=1), pixels.amax(dim=1)) if len(boxes) else (pixels[:, 0], pixels[:, 0])
        image = torch.cat((low, high), dim=1)  # (N, 4)
        if image_size is not None:
            limit = torch.tensor([image_size[0] - 1, image_size[1] - 1] * 2, dtype=image.dtype)
            image = torch.minimum(image.clamp(min=0), limit)
        return image
