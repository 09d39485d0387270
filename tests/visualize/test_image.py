"""Boxes in the camera image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from beambox.checks import BeamboxError
from beambox.data.kitti import parse_calibration
from beambox.infer.inputs import read_sweep
from beambox.structures import Detections, Labels
from beambox.visualize.image import box_edges, draw_camera, open_image
from beambox.visualize.picture import draw_sweep
from oracles.paths import data_dir
from oracles.tiny_detector import CALIBRATION_TEXT

CALIBRATION = parse_calibration(CALIBRATION_TEXT)


def test_a_box_ahead_projects_to_twelve_edges_where_its_corners_are() -> None:
    box = torch.tensor([20.0, 1.0, -0.9, 4.0, 2.0, 1.5, 0.4])
    edges = box_edges(box, CALIBRATION)
    assert len(edges) == 12
    ends = torch.tensor(edges).reshape(-1, 2)
    image = CALIBRATION.to_camera(box[None]).image[0]
    assert torch.allclose(ends.amin(dim=0).double(), image[:2], atol=1e-3)
    assert torch.allclose(ends.amax(dim=0).double(), image[2:], atol=1e-3)


def test_edges_are_cut_at_the_camera_and_boxes_behind_are_not_drawn() -> None:
    beside = box_edges(torch.tensor([0.5, 2.0, -0.9, 4.0, 1.0, 1.5, 0.0]), CALIBRATION)
    assert 0 < len(beside) < 12
    assert np.isfinite(np.array(beside)).all()
    assert np.array(beside)[:, :, 0].max() < 650, "what is cut stays on its own side, left of the middle"
    assert box_edges(torch.tensor([-20.0, 0.0, -0.9, 4.0, 2.0, 1.5, 0.0]), CALIBRATION) == []


def test_drawing_changes_the_image_where_the_box_is_and_nowhere_else() -> None:
    image = Image.new("RGB", (1200, 360), (90, 110, 130))
    box = torch.tensor([[20.0, 5.0, -0.9, 4.0, 2.0, 1.5, 0.0]])
    found = Detections(box, torch.tensor([0.8]), torch.tensor([0]), ("Car",))
    drawn = np.asarray(draw_camera(image, CALIBRATION, found, Labels(box, ("Car",)))).astype(int)
    changed = np.argwhere(np.abs(drawn - np.asarray(image)).sum(axis=-1) > 0)
    left, top, right, bottom = CALIBRATION.to_camera(box).image[0].tolist()
    assert len(changed) > 100
    assert changed[:, 0].min() > top - 24 and changed[:, 0].max() < bottom + 6
    assert changed[:, 1].min() > left - 60 and changed[:, 1].max() < right + 60


def test_an_image_without_boxes_is_left_as_it_is() -> None:
    image = Image.effect_noise((64, 48), 50).convert("RGB")
    assert np.array_equal(np.asarray(draw_camera(image, CALIBRATION)), np.asarray(image))


def test_files_that_are_no_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("no image", encoding="utf-8")
    with pytest.raises(BeamboxError, match="must be an image"):
        open_image(tmp_path / "a.png")
    with pytest.raises(BeamboxError, match="is not there"):
        open_image(tmp_path / "b.png")


def test_a_real_sweep_has_both_views() -> None:
    frame = read_sweep(data_dir("kitti", "training", "velodyne", "000008.bin"), labels=True)
    both = draw_sweep(frame, labels=frame.labels)
    from dataclasses import replace

    alone = draw_sweep(replace(frame, image_path=None), labels=frame.labels)
    assert both.width == alone.width and both.height > alone.height + 300
