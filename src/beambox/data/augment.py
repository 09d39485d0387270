"""Augmentation of labelled sweeps, in the order of SECOND and PointPillars; every step is frame in, frame out.

1. objects from the database (``sample``), 2. every object turned and shifted by itself (``object_*``), 3. mirrored,
4. the whole turned about the sensor, 5. scaled, 6. shifted, 7. points shuffled. Points move with their boxes.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.data.bev_overlap import bev_overlap
from beambox.data.database import ObjectDatabase
from beambox.data.ground_plane import fit_ground_plane
from beambox.geometry.boxes import flip_boxes_x, flip_boxes_y, rotate_boxes, scale_boxes
from beambox.ops.points_in_boxes import points_in_boxes
from beambox.structures import Frame, Labels

__all__ = [
    "AugmentConfig",
    "augment",
    "flip_x",
    "flip_y",
    "move_objects",
    "rotate",
    "sample_objects",
    "scale",
    "shuffle_points",
    "translate",
]

Probability = Annotated[float, Field(ge=0, le=1)]
FIRST_TRIALS = 10


class AugmentConfig(BaseModel):
    """What to do to a training frame; the defaults are Voxel R-CNN's for cars. Zero turns a step off."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sample: dict[str, Annotated[int, Field(ge=0)]] = Field(default_factory=lambda: {"Car": 15})
    """Objects drawn from the database a frame, by class, in the order of drawing."""
    sample_whole_scene: bool = False
    """Count the objects already present: draw only what is missing to the number."""
    sample_on_road: bool = True
    """Shift drawn objects in z so that they stand on the road plane."""
    object_rotation: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    """Each object turns about its own centre by U(-this, this), radians."""
    object_translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Each object shifts by N(0, this) along x, y, z, metres."""
    object_trials: Annotated[int, Field(ge=1)] = 100
    """Draws of rotation and shift an object gets until one collides with no other; then it stays."""
    flip_x: Probability = 0.5
    """Probability of mirroring across the x axis (y -> -y)."""
    flip_y: Probability = 0.0
    """Probability of mirroring across the y axis (x -> -x); only for sweeps that see all around."""
    rotation: Annotated[float, Field(ge=0, le=math.pi)] = math.pi / 4
    """The whole turns about the sensor by U(-this, this), radians."""
    scaling: tuple[float, float] = (0.95, 1.05)
    """The whole is scaled by U(lowest, highest)."""
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The whole shifts by N(0, this) along x, y, z, metres (CenterPoint, section 5)."""
    shuffle: bool = True
    """Shuffle the points, so that a limit of points a cell keeps a random subset."""


def augment(
    frame: Frame,
    rng: np.random.Generator,
    config: AugmentConfig,
    database: ObjectDatabase | None = None,
    draw_index: int = 0,
    seed: int = 0,
) -> Frame:
    """Augment a labelled frame; its camera no longer fits the points and is dropped.

    Args:
        frame: with labels; neither it nor its tensors are changed.
        rng: source of every draw but those from the database.
        config: what to do.
        database: objects to sample from; None samples none.
        draw_index: number of the frame in the run, which tells where the walk through the database stands.
        seed: names the walk through the database.

    Raises:
        BeamboxError: if the frame has no labels.
    """
    if frame.labels is None:
        raise BeamboxError(f"only labelled frames can be augmented, but {frame.id or 'this one'} has no labels")
    # keep the draws in one order whatever is switched on, so that one step's setting does not change another's numbers
    noise_rng, shuffle_rng, shift_rng = rng.spawn(3)
    mirror_x, mirror_y = rng.random(2)
    angle, factor = rng.uniform(-1, 1), rng.uniform(*config.scaling)
    if database is not None:
        frame = sample_objects(frame, config, database, draw_index, seed)
    frame = replace(frame, calibration=None, image_path=None, image_size=None, plane=None)
    if config.object_rotation > 0 or any(sigma > 0 for sigma in config.object_translation):
        frame = move_objects(
            frame, noise_rng, config.object_rotation, config.object_translation, trials=config.object_trials
        )
    if mirror_x < config.flip_x:
        frame = flip_x(frame)
    if mirror_y < config.flip_y:
        frame = flip_y(frame)
    frame = rotate(frame, angle * config.rotation)
    frame = scale(frame, factor)
    if any(sigma > 0 for sigma in config.translation):
        frame = translate(frame, shift_rng.normal(0.0, 1.0, 3) * config.translation)
    return shuffle_points(frame, shuffle_rng) if config.shuffle else frame


def sample_objects(frame: Frame, config: AugmentConfig, database: ObjectDatabase, draw_index: int, seed: int) -> Frame:
    """Place objects from the database where they stood in their own sweeps, if they stand free there.

    Scene points inside an accepted box are removed, the objects' points come first. Without a road plane in the frame
    one is fitted; where none can be fitted the objects keep their height.
    """
    labels = _labels(frame)
    present = Counter(labels.names) if config.sample_whole_scene else None
    scene_boxes = labels.boxes.numpy()
    objects, names = database.sample(scene_boxes, list(config.sample.items()), draw_index, seed, present)
    if len(objects) == 0:
        return frame
    boxes = database.boxes[objects]  # (K, 7), a copy
    plane = frame.plane if frame.plane is not None or not config.sample_on_road else fit_ground_plane(frame.points)
    if plane is not None and config.sample_on_road:
        a, b, c, d = plane.tolist()
        boxes[:, 2] = -(a * boxes[:, 0] + b * boxes[:, 1] + d) / c + boxes[:, 5] / 2
    scene = frame.points.numpy()
    if scene.shape[1] != database.points.shape[1]:
        raise BeamboxError(
            f"frame {frame.id} has {scene.shape[1]} point columns, the object database {database.points.shape[1]}; "
            "build the database from frames read with the same fields"
        )
    hidden = points_in_boxes(frame.points, torch.from_numpy(boxes)).numpy() >= 0  # (N,)
    points = np.concatenate((database.points_of(objects, boxes[:, :3]), scene[~hidden]))
    together = Labels(torch.from_numpy(np.concatenate((scene_boxes, boxes))), (*labels.names, *names))
    return replace(frame, points=torch.from_numpy(points), labels=together)


def move_objects(
    frame: Frame,
    rng: np.random.Generator,
    rotation: float,
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
    trials: int = 100,
) -> Frame:
    """Turn and shift every object by itself, points with it; one that would always collide stays (SECOND, section 3.2).

    Args:
        frame: with labels.
        rng: source of the draws.
        rotation: each turns about its centre by U(-rotation, rotation), radians.
        translation: each shifts by N(0, translation), metres along x, y, z.
        trials: draws an object gets; the first that overlaps no other box, in BEV, holds.
    """
    labels = _labels(frame)
    if len(labels) == 0:
        return frame
    boxes = labels.boxes.numpy().astype(np.float64)  # (N, 7), changed below
    turns = rng.uniform(-rotation, rotation, (len(boxes), trials))
    shifts = rng.normal(0.0, 1.0, (len(boxes), trials, 3)) * translation
    cloud = frame.points.numpy().copy()
    for k, rows in enumerate(_rows_of_objects(frame, labels.boxes)):
        tries = np.repeat(boxes[k : k + 1], trials, axis=0)  # (trials, 7)
        tries[:, :3] += shifts[k]
        tries[:, 6] += turns[k]
        best = _first_free(tries, np.delete(boxes, k, axis=0))
        if best is None:
            continue
        offset = cloud[rows, :3] - boxes[k, :3]  # (P, 3)
        cos, sin = np.cos(turns[k, best]), np.sin(turns[k, best])
        turned = np.stack((cos * offset[:, 0] - sin * offset[:, 1], sin * offset[:, 0] + cos * offset[:, 1]), axis=1)
        cloud[rows, :3] = np.concatenate((turned, offset[:, 2:]), axis=1) + tries[best, :3]
        boxes[k] = tries[best]
    boxes[:, 6] = (boxes[:, 6] + np.pi) % (2 * np.pi) - np.pi
    return replace(frame, points=torch.from_numpy(cloud), labels=labels.with_boxes(torch.from_numpy(boxes)))


def _rows_of_objects(frame: Frame, boxes: Tensor) -> list[np.ndarray]:
    """Point indices inside each box; a point in two boxes belongs to the first."""
    owner = points_in_boxes(frame.points, boxes).numpy()
    inside = np.flatnonzero(owner >= 0)
    inside = inside[np.argsort(owner[inside], kind="stable")]
    return np.split(inside, np.searchsorted(owner[inside], np.arange(1, len(boxes))))


def _first_free(tries: np.ndarray, others: np.ndarray) -> int | None:
    """Return the first of ``(T, 7)`` boxes that overlaps none of ``(M, 7)``; most often it is one of the first few."""
    for part in (slice(0, FIRST_TRIALS), slice(FIRST_TRIALS, None)):
        free = np.flatnonzero(~bev_overlap(tries[part, None], others).any(axis=1))
        if len(free):
            return int(free[0]) + (part.start or 0)
    return None


def flip_x(frame: Frame) -> Frame:
    """Mirror points and boxes across the x axis: y -> -y."""
    points = frame.points.clone()
    points[:, 1] = -points[:, 1]
    labels = _labels(frame)
    return replace(frame, points=points, labels=labels.with_boxes(flip_boxes_x(labels.boxes)))


def flip_y(frame: Frame) -> Frame:
    """Mirror points and boxes across the y axis: x -> -x."""
    points = frame.points.clone()
    points[:, 0] = -points[:, 0]
    labels = _labels(frame)
    return replace(frame, points=points, labels=labels.with_boxes(flip_boxes_y(labels.boxes)))


def rotate(frame: Frame, angle: float) -> Frame:
    """Turn points and boxes about the sensor's z axis by ``angle`` radians, counter-clockwise in BEV."""
    points = frame.points.clone()
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = frame.points[:, 0], frame.points[:, 1]
    points[:, 0] = cos * x - sin * y
    points[:, 1] = sin * x + cos * y
    labels = _labels(frame)
    return replace(frame, points=points, labels=labels.with_boxes(rotate_boxes(labels.boxes, angle)))


def scale(frame: Frame, factor: float) -> Frame:
    """Scale points, and boxes' centres and sizes, about the sensor."""
    points = frame.points.clone()
    points[:, :3] *= factor
    labels = _labels(frame)
    return replace(frame, points=points, labels=labels.with_boxes(scale_boxes(labels.boxes, factor)))


def translate(frame: Frame, shift: np.ndarray) -> Frame:
    """Shift points and boxes by ``(3,)`` metres along x, y, z."""
    points, boxes = frame.points.clone(), _labels(frame).boxes.clone()
    offset = torch.from_numpy(shift).to(points.dtype)
    points[:, :3] += offset
    boxes[:, :3] += offset
    return replace(frame, points=points, labels=_labels(frame).with_boxes(boxes))


def shuffle_points(frame: Frame, rng: np.random.Generator) -> Frame:
    """Put the points in random order."""
    return frame.with_points(torch.from_numpy(frame.points.numpy()[rng.permutation(len(frame))]))


def _labels(frame: Frame) -> Labels:
    if frame.labels is None:
        raise BeamboxError(f"only labelled frames can be augmented, but {frame.id or 'this one'} has no labels")
    return frame.labels
