"""Each usual mistake in units, axes, signs and orders is made on purpose, and `data check` must name it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from beambox.data.checking import check_frames
from beambox.data.custom import CustomSource
from beambox.data.format_report import warnings
from beambox.data.kitti import KittiSource
from oracles.own_data import SENSOR_HEIGHT, scene, write_pandaset, write_sweep


def mirror(boxes: np.ndarray, axis: int) -> np.ndarray:
    boxes[:, axis] *= -1
    boxes[:, 6] = -boxes[:, 6] if axis else math.pi - boxes[:, 6]
    return boxes


def exchange(boxes: np.ndarray) -> np.ndarray:
    boxes[:, [0, 1]] = boxes[:, [1, 0]]
    boxes[:, 6] = math.pi / 2 - boxes[:, 6]
    return boxes


def camera(boxes: np.ndarray) -> np.ndarray:
    x, y, z, length, width, height, yaw = boxes.T
    return np.stack((-y, -z + height / 2, x, length, width, height, -yaw - math.pi / 2), axis=1)


def scale(boxes: np.ndarray, factor: float) -> np.ndarray:
    boxes[:, :6] *= factor
    return boxes


def degrees(boxes: np.ndarray) -> np.ndarray:
    boxes[:, 6] = np.rad2deg(boxes[:, 6])
    return boxes


MISTAKES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "y": (lambda boxes: mirror(boxes, 1), "y of the boxes leads the other way"),
    "x": (lambda boxes: mirror(boxes, 0), "x of the boxes leads the other way"),
    "xy": (exchange, "x and y are in the other order"),
    "camera": (camera, "the boxes are in a camera's axes"),
    "mm": (lambda boxes: scale(boxes, 1000), "are these millimetres"),
    "cm": (lambda boxes: scale(boxes, 100), "the boxes are in centimetres"),
    "hwl": (lambda boxes: boxes[:, [0, 1, 2, 5, 4, 3, 6]], "are the sizes in the order h, w, l?"),
    "degrees": (degrees, "is it in degrees? Radians are expected"),
    "other frames": (lambda boxes: boxes + np.array([3.3, 5, 0, 0, 0, 0, 0]), "are the labels those of other frames"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_of_labels_are_named(tmp_path: Path, name: str) -> None:
    change, wanted = MISTAKES[name]
    source = CustomSource(write_pandaset(tmp_path, 3, f"sensor_height: {SENSOR_HEIGHT}\n", change), whole=True)
    lines = warnings(check_frames(source))
    assert any(wanted in line for line in lines), lines


def test_sound_labels_are_accused_of_nothing(tmp_path: Path) -> None:
    source = CustomSource(write_pandaset(tmp_path, 3, f"sensor_height: {SENSOR_HEIGHT}\n"), whole=True)
    assert warnings(check_frames(source)) == []


def test_points_in_millimeters_and_on_their_head_are_named(tmp_path: Path) -> None:
    path = write_pandaset(tmp_path, 2, "")
    for seed, factor in ((0, [1000, 1000, 1000, 1]), (1, [1000, 1000, 1000, 1])):
        write_sweep(tmp_path / f"velodyne/{seed:02d}.bin", scene(seed)[0] * np.array(factor))
    lines = warnings(check_frames(CustomSource(path, whole=True)))
    assert any("these are millimetres or map coordinates" in line for line in lines)
    assert any("the points are in millimetres, the boxes in metres" in line for line in lines)
    for seed in (0, 1):
        write_sweep(tmp_path / f"velodyne/{seed:02d}.bin", scene(seed)[0] * np.array([1, -1, -1, 1]))
    lines = warnings(check_frames(CustomSource(path, whole=True)))
    assert any("-z is up, but z is expected to be: set axes" in line for line in lines), lines


def test_an_intensity_scaled_differently_from_frame_to_frame_is_named(tmp_path: Path) -> None:
    """A 12-bit sensor: frames with nothing bright in them look like 8 bits."""
    path = write_pandaset(tmp_path, 3, f"sensor_height: {SENSOR_HEIGHT}\n")
    for seed, top in ((0, 250), (1, 4000), (2, 4000)):
        write_sweep(tmp_path / f"velodyne/{seed:02d}.bin", scene(seed)[0] * np.array([1, 1, 1, top]))
    lines = warnings(check_frames(CustomSource(path, whole=True)))
    assert any("intensity was divided by 255 in 1 frames, by 65535 in 2 frames" in line for line in lines), lines


@pytest.mark.parametrize(
    ("boxes", "wanted"),
    [
        (["0 0 0 0"] * 3, "all image boxes are 0 (labels made without a camera)"),
        (["0 0 0 0", "9 9 50 50", "9 9 50 50"], "1 of 3 boxes have no box in the image"),
    ],
)
def test_labels_without_image_boxes_are_named(tmp_path: Path, boxes: list[str], wanted: str) -> None:
    calib = (
        "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    for kind in ("label_2", "calib"):
        (tmp_path / "training" / kind).mkdir(parents=True)
    for k, box in enumerate(boxes):
        write_sweep(tmp_path / f"training/velodyne/{k:06d}.bin", scene(k)[0])
        (tmp_path / f"training/calib/{k:06d}.txt").write_text(calib, encoding="utf-8")
        line = f"Car 0 0 0 {box} 1.5 1.6 3.9 -1 1.6 9 0\n"
        (tmp_path / f"training/label_2/{k:06d}.txt").write_text(line, encoding="utf-8")
    assert any(wanted in line for line in warnings(check_frames(KittiSource(tmp_path, "all"))))
