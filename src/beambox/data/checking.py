"""Read a whole data set and say what looks wrong before anything is trained on it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beambox.checks import BeamboxError
from beambox.data.ground_plane import height_and_slope
from beambox.data.placements import BEYOND_A_TURN, count_filled, up_axis
from beambox.data.source import FrameSource
from beambox.ops.points_in_boxes import points_in_boxes_mask
from beambox.structures import Frame

__all__ = ["BoxFacts", "ClassFacts", "DataReport", "check_frames", "inspect_boxes"]

Floats = NDArray[np.float64]
TELLING_POINTS = 20
"""Boxes with fewer points around them say nothing about their heading."""
MARGIN = 0.1
"""Boxes are widened by this much on all sides when their heading is looked at, metres."""
NEARBY = 2.0
"""Points this far around a box tell where the ground is, metres."""
SOME_FRAMES = 20
"""Frames in which the axis that is up is looked for."""
MANY_BOXES = 500
"""So many boxes tell whether they lie where their points are."""
FLOATING = 0.5
"""A class whose boxes stand this far from the ground is reported, metres."""


@dataclass(frozen=True)
class BoxFacts:
    """What is known of each labelled box; M boxes."""

    boxes: Floats
    """``(M, 7)``."""
    points: NDArray[np.int64]
    """``(M,)`` points inside."""
    gap: Floats
    """``(M,)`` lower face less the ground nearby, metres; NaN where no ground is seen."""
    as_labeled: NDArray[np.int64]
    """``(M,)`` points inside the widened box."""
    across: NDArray[np.int64]
    """``(M,)`` points inside the box turned by 90 degrees."""
    mirrored: NDArray[np.int64]
    """``(M,)`` points inside the box turned the other way round: heading clockwise instead of counter-clockwise."""

    def only(self, rows: NDArray[np.bool_]) -> BoxFacts:
        """Keep some of the boxes."""
        return BoxFacts(
            self.boxes[rows],
            self.points[rows],
            self.gap[rows],
            self.as_labeled[rows],
            self.across[rows],
            self.mirrored[rows],
        )

    @classmethod
    def join(cls, parts: Sequence[BoxFacts]) -> BoxFacts:
        """Put the boxes of several frames in one row."""
        return cls(
            np.concatenate([part.boxes for part in parts]),
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.gap for part in parts]),
            np.concatenate([part.as_labeled for part in parts]),
            np.concatenate([part.across for part in parts]),
            np.concatenate([part.mirrored for part in parts]),
        )


def inspect_boxes(frame: Frame) -> BoxFacts:
    """Look at the points in and around each labelled box of a frame."""
    assert frame.labels is not None
    boxes = frame.labels.boxes.double()
    xyz = frame.points[:, :3].double()
    wide = boxes.clone()
    wide[:, 3:6] += 2 * MARGIN
    turned, flipped = wide.clone(), wide.clone()
    turned[:, 6] += math.pi / 2
    flipped[:, 6] *= -1
    counts = [points_in_boxes_mask(xyz, each).sum(dim=1).numpy() for each in (boxes, wide, turned, flipped)]
    return BoxFacts(boxes.numpy(), counts[0], _gaps(xyz.numpy(), boxes.numpy()), *counts[1:])


def _gaps(xyz: Floats, boxes: Floats) -> Floats:
    """Return how far each box's lower face lies above the low points around it."""
    gaps = np.full(len(boxes), np.nan)
    for k, box in enumerate(boxes):
        reach = np.hypot(box[3], box[4]) / 2 + NEARBY
        near = (np.abs(xyz[:, 0] - box[0]) < reach) & (np.abs(xyz[:, 1] - box[1]) < reach)
        heights = xyz[near, 2]
        heights = heights[np.abs(heights - box[2]) < box[5] + 3]
        if len(heights) >= TELLING_POINTS:
            gaps[k] = box[2] - box[5] / 2 - np.percentile(heights, 5)
    return gaps


@dataclass
class ClassFacts:
    """What is known of one class's boxes."""

    parts: list[BoxFacts] = field(default_factory=list)
    """One entry a frame that has the class."""
    outside: int = 0
    """Boxes outside the range."""

    def joined(self) -> BoxFacts:
        """Return all boxes in one row."""
        return BoxFacts.join(self.parts)


@dataclass
class DataReport:
    """What :func:`check_frames` found."""

    frames: int = 0
    """Frames looked at."""
    unlabeled: list[str] = field(default_factory=list)
    """Frames without a label file."""
    without_points: list[str] = field(default_factory=list)
    """Frames without a point."""
    without_boxes: list[str] = field(default_factory=list)
    """Labelled frames without a box."""
    unreadable: list[str] = field(default_factory=list)
    """What could not be read, one message a frame."""
    point_counts: list[int] = field(default_factory=list)
    """Points of each frame."""
    ground: list[float] = field(default_factory=list)
    """Height of the fitted ground under the origin, where one was found."""
    slopes: list[tuple[float, float]] = field(default_factory=list)
    """Metres that the fitted ground rises a metre forward and to the left, likewise."""
    intensity: list[tuple[float, float]] = field(default_factory=list)
    """Lowest and highest intensity of each frame."""
    notes: dict[str, int] = field(default_factory=dict)
    """What reading had to decide, and in how many frames; # stands for digits that differ from frame to frame."""
    note_texts: dict[str, set[str]] = field(default_factory=dict)
    """The texts behind each of them."""
    scales: dict[str, int] = field(default_factory=dict)
    """What the intensity was divided by ("1" where it was not), and in how many frames."""
    reach: list[float] = field(default_factory=list)
    """Distance within which 95 % of the points of each frame lie, metres."""
    up: dict[str, int] = field(default_factory=dict)
    """Axis other than +z that is up, and in how many frames."""
    placements: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Boxes that hold something, and points in them, as labelled and after usual mistakes; over a few frames."""
    placed: int = 0
    """Boxes that ``placements`` looked at."""
    beyond_a_turn: int = 0
    """Boxes whose yaw is larger than a full turn in radians."""
    image_boxes: tuple[int, int] = (0, 0)
    """Boxes without a box in the image, and boxes in all, where labels have such boxes."""
    by_class: dict[str, ClassFacts] = field(default_factory=dict)
    """Facts of each class."""

    def add(self, frame: Frame, limits: Sequence[float] | None) -> None:
        """Take a frame into account.

        Args:
            frame: with everything that its files hold.
            limits: x0, y0, x1, y1 of the data set's range.
        """
        self.frames += 1
        self.point_counts.append(len(frame))
        for note in frame.notes:
            pattern = "".join("#" if letter.isdigit() else letter for letter in note)
            self.notes[pattern] = self.notes.get(pattern, 0) + 1
            self.note_texts.setdefault(pattern, set()).add(note)
        if len(frame):
            values = frame.points[:, 3]
            self.intensity.append((float(values.min()), float(values.max())))
            self._add_points(frame)
        else:
            self.without_points.append(frame.id)
        if frame.plane is not None:
            ground, slope = height_and_slope(frame.plane)
            self.ground.append(ground)
            self.slopes.append(slope)
        if frame.labels is None:
            self.unlabeled.append(frame.id)
            return
        if not len(frame.labels):
            self.without_boxes.append(frame.id)
            return
        self._add_placements(frame)
        facts = inspect_boxes(frame)
        names = np.array(frame.labels.names)
        x, y = facts.boxes[:, 0], facts.boxes[:, 1]
        low_x, low_y, high_x, high_y = limits or (-np.inf, -np.inf, np.inf, np.inf)
        inside = (x >= low_x) & (x < high_x) & (y >= low_y) & (y < high_y)
        for name in dict.fromkeys(frame.labels.names):
            rows = names == name
            class_facts = self.by_class.setdefault(name, ClassFacts())
            class_facts.parts.append(facts.only(rows))
            class_facts.outside += int((rows & ~inside).sum())

    def _add_points(self, frame: Frame) -> None:
        scale = next((note.split()[-1] for note in frame.notes if note.startswith("intensity divided by ")), "1")
        self.scales[scale] = self.scales.get(scale, 0) + 1
        some = frame.points[:: max(1, len(frame) // 10_000), :3].double()
        self.reach.append(float(some.norm(dim=1).quantile(0.95)))
        if len(self.reach) <= SOME_FRAMES:
            up = up_axis(frame.points)
            if up is not None:
                self.up[up] = self.up.get(up, 0) + 1

    def _add_placements(self, frame: Frame) -> None:
        assert frame.labels is not None
        self.beyond_a_turn += int((frame.labels.boxes[:, 6].abs() > BEYOND_A_TURN).sum())
        attributes = frame.labels.attributes
        if attributes is not None:
            image = attributes.image
            without = int(((image[:, 2] <= image[:, 0]) | (image[:, 3] <= image[:, 1])).sum())
            self.image_boxes = (self.image_boxes[0] + without, self.image_boxes[1] + len(image))
        if self.placed > MANY_BOXES or not len(frame):
            return
        self.placed += len(frame.labels)
        for name, (filled, points) in count_filled(frame).items():
            boxes, total = self.placements.get(name, (0, 0))
            self.placements[name] = (boxes + filled, total + points)


def check_frames(
    source: FrameSource, indices: Iterable[int] | None = None, limits: Sequence[float] | None = None
) -> DataReport:
    """Read frames one after another and collect what is to be said about them.

    Args:
        source: the data set.
        indices: which frames; None takes all.
        limits: x0, y0, x1, y1 of the range, where there is one.
    """
    report = DataReport()
    for index in range(len(source)) if indices is None else indices:
        try:
            frame = source[index]
        except BeamboxError as error:
            report.frames += 1
            report.unreadable.append(str(error))
            continue
        report.add(frame, limits)
    return report
