"""Make another sensor's points look like those the weights were trained on, and carry the boxes back."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from torch import Tensor

from beambox.geometry.axes import Axes, level_shift, turn_boxes
from beambox.structures import Detections, Frame

__all__ = ["SensorAlignment"]


@dataclass(frozen=True)
class SensorAlignment:
    """What has to be done to points before the network sees them; the defaults do nothing."""

    axes: Axes = field(default_factory=Axes)
    """Where the axes of the points lead."""
    z_offset: float = 0.0
    """Metres added to z: this sensor's height above the ground less that of the training data's."""
    slope: tuple[float, float] = (0.0, 0.0)
    """Metres that the ground rises a metre forward and a metre to the left; taken away from z."""

    @property
    def nothing(self) -> bool:
        """Whether points stay as they are."""
        return self == SensorAlignment()

    def apply(self, frame: Frame) -> Frame:
        """Return the frame as the network is to see it."""
        if self.nothing:
            return frame
        points = frame.points.clone()
        points[:, :3] = points[:, :3] @ self.axes.matrix.T.to(points)
        points[:, 2] += self._shift(points)
        return frame.with_points(points)

    def to_sensor(self, detections: Detections) -> Detections:
        """Bring boxes into the frame of the points as they were given.

        Where the given z is not vertical, a box cannot turn about it: boxes then stay in x forward, y left, z up.
        """
        boxes = detections.boxes.clone()
        boxes[:, 2] -= self._shift(boxes)
        if self.axes.vertical_z:
            boxes = turn_boxes(boxes, self.axes.matrix.T)  # the inverse of a rotation is its transpose
        return replace(detections, boxes=boxes)

    def from_sensor(self, boxes: Tensor) -> Tensor:
        """Bring ``(N, 7)`` boxes of the given frame to where :meth:`apply` brings its points."""
        boxes = turn_boxes(boxes, self.axes.matrix) if self.axes.vertical_z else boxes.clone()
        boxes[:, 2] += self._shift(boxes)
        return boxes

    def _shift(self, rows: Tensor) -> Tensor:
        """Metres added to z of points or boxes whose axes have been turned: ``(N,)``."""
        return level_shift(rows, self.z_offset, self.slope)
