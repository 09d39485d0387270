"""Ground truth of one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_finite, expect_same_length, expect_shape

__all__ = ["ImageAttributes", "Labels"]


@dataclass(frozen=True)
class ImageAttributes:
    """What KITTI's label files say of each object beyond its box; length N."""

    truncation: Tensor
    """``(N,)`` share of the object outside the image, 0 to 1."""
    occlusion: Tensor
    """``(N,)`` int64: 0 visible, 1 partly, 2 largely occluded, 3 unknown."""
    alpha: Tensor
    """``(N,)`` observation angle, radians."""
    image: Tensor
    """``(N, 4)`` left, top, right, bottom in pixels."""
    camera: Tensor | None = None
    """``(N, 7)`` float64 h, w, l, x, y, z, rotation_y exactly as a label file has them (bottom centre in the rectified
    camera frame; metres, radians), or None where the boxes did not come from one."""

    def __post_init__(self) -> None:
        expect_shape("image", self.image, ("N", 4))
        expect_same_length(
            truncation=len(self.truncation), occlusion=len(self.occlusion), alpha=len(self.alpha), image=len(self.image)
        )
        if self.camera is not None:
            expect_shape("camera", self.camera, (len(self.image), 7))

    def __getitem__(self, index: Tensor | slice) -> ImageAttributes:
        camera = None if self.camera is None else self.camera[index]
        return ImageAttributes(
            self.truncation[index], self.occlusion[index], self.alpha[index], self.image[index], camera
        )

    def difficulty(self) -> Tensor:
        """KITTI's level of each object, ``(N,)`` int64: 0 easy, 1 moderate, 2 hard, -1 beyond hard (the devkit)."""
        height = self.image[:, 3] - self.image[:, 1] + 1
        level = torch.full((len(self.image),), -1)
        for rank, (tall, cut, hidden) in reversed(list(enumerate(((40, 0.15, 0), (25, 0.30, 1), (25, 0.50, 2))))):
            fits = (height >= tall) & (self.truncation <= cut) & (self.occlusion <= hidden)
            level[fits] = rank
        return level


@dataclass(frozen=True)
class Labels:
    """Boxes of the objects in a frame and their class names; slices like a sequence."""

    boxes: Tensor
    """``(N, 7)`` float32 x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""
    names: tuple[str, ...]
    """Class of each box."""
    attributes: ImageAttributes | None = None
    """KITTI's further columns, where the data has them."""
    ignored_image: Tensor = field(default_factory=lambda: torch.zeros(0, 4))
    """``(K, 4)`` image regions that nobody labelled (KITTI's DontCare), pixels."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", torch.as_tensor(self.boxes, dtype=torch.float32))
        object.__setattr__(self, "names", tuple(self.names))
        expect_shape("boxes", self.boxes, ("N", 7))
        expect_finite("boxes", self.boxes)
        expect_same_length(boxes=len(self.boxes), names=len(self.names))
        if bool((self.boxes[:, 3:6] < 0).any()):
            raise BeamboxError("`boxes` must have sizes of at least 0, got a negative length, width or height")
        if self.attributes is not None:
            expect_same_length(boxes=len(self.boxes), attributes=len(self.attributes.image))

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: Tensor | Sequence[bool] | slice) -> Labels:
        """Select by a boolean mask, an index tensor or a slice."""
        if not isinstance(index, slice):
            index = torch.as_tensor(index)
        rows = torch.arange(len(self))[index].tolist()
        attributes = None if self.attributes is None else self.attributes[index]
        return replace(self, boxes=self.boxes[index], names=tuple(self.names[i] for i in rows), attributes=attributes)

    def of_classes(self, classes: Sequence[str]) -> Labels:
        """Keep the objects whose class is one of ``classes``."""
        return self[torch.tensor([name in classes for name in self.names], dtype=torch.bool)]

    def class_index(self, classes: Sequence[str]) -> Tensor:
        """Return each object's position in ``classes``, or -1: ``(N,)`` int64."""
        place = {name: i for i, name in enumerate(classes)}
        return torch.tensor([place.get(name, -1) for name in self.names], dtype=torch.int64)

    def with_boxes(self, boxes: Tensor) -> Labels:
        """Return the same objects at other places (image attributes no longer hold and are dropped)."""
        return Labels(boxes, self.names)

    @classmethod
    def empty(cls) -> Labels:
        """No objects."""
        return cls(torch.zeros(0, 7), ())
