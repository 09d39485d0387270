from __future__ import annotations

import io
import math
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.kitti import write_kitti_frame, write_split
from beambox.simulate import simulate_frame
from beambox.simulate.frames import CAMERA
from beambox.simulate.layouts import layout_frames, pick_layout, scene
from beambox.simulate.stage import overlaps
from beambox.structures import Frame, Labels
from oracles.paths import data_dir

BOXES = torch.tensor(
    [
        [12.0, 3.0, -0.95, 3.9, 1.6, 1.5, 0.1],
        [20.0, -4.0, -0.80, 4.3, 1.7, 1.5, -3.0],
        [15.0, -1.0, -0.75, 0.8, 0.6, 1.75, 1.0],
        [28.0, 2.0, -0.50, 5.2, 1.9, 2.2, 1.6],
    ]
)
NAMES = ("Car", "Car", "Pedestrian", "Van")


def layout_folder(root: Path, ids: tuple[str, ...] = ("000003",)) -> Path:
    for name in ids:
        write_kitti_frame(root, Frame(torch.zeros(0, 4), name, Labels(BOXES, NAMES), CAMERA, image_size=(1242, 375)))
    return root


def test_layout_from_label_files_reproduces_the_boxes(tmp_path) -> None:
    frame = simulate_frame(2, 0, layout=f"kitti:{layout_folder(tmp_path)}")
    assert frame.labels.names == NAMES
    away = frame.labels.boxes - BOXES
    away[:, 6] = torch.remainder(away[:, 6] + math.pi, 2 * math.pi) - math.pi
    assert float(away.abs().max()) < 0.02  # labels are written with two decimals
    assert torch.allclose(frame.calibration.p2, CAMERA.p2)
    assert frame.notes == ("layout 000003",)


def test_scenery_stays_clear_of_the_objects(tmp_path) -> None:
    layout = pick_layout(str(layout_folder(tmp_path)), None, np.random.default_rng(0))
    for seed in range(3):
        stage = scene(np.random.default_rng(seed), 1.73, False, layout)
        taken = stage._taken  # the ego vehicle, the objects, then scenery
        assert len(taken) > 15
        for k in range(1, 5):
            touching = overlaps(taken[k], taken)
            assert set(np.flatnonzero(touching)) == {k}


def test_overlap_of_rectangles() -> None:
    others = np.array([[3.0, 0.0, 1.0, 1.0, 0.0], [3.0, 0.0, 1.0, 1.0, math.pi / 4], [0.0, 2.2, 2.0, 0.1, 0.0]])
    np.testing.assert_array_equal(overlaps(np.array([0.0, 0.0, 1.7, 1.0, 0.0]), others), [False, True, False])
    assert overlaps(np.zeros(5), np.zeros((0, 5))).shape == (0,)


def test_split_of_the_layouts_is_kept(tmp_path) -> None:
    layout_folder(tmp_path, ("000001", "000002", "000005"))
    write_split(tmp_path, "train", ["000002"])
    assert [f[0] for f in layout_frames(str(tmp_path), "train")] == ["000002"]
    assert len(layout_frames(str(tmp_path), None)) == 3
    assert len(layout_frames(str(tmp_path), "other")) == 3  # no such list: every frame


def test_archives_are_read_and_bad_ones_refused(tmp_path) -> None:
    root = layout_folder(tmp_path / "data")
    archive = tmp_path / "labels.tar.gz"
    with tarfile.open(archive, "w:gz") as tar:
        tar.add(root / "training", "training")
        info = tarfile.TarInfo("ImageSets/train.txt")
        info.size = 7
        tar.addfile(info, io.BytesIO(b"000003\n"))
    assert layout_frames(str(archive), "train")[0][0] == "000003"
    broken = tmp_path / "broken.tar.gz"
    broken.write_bytes(archive.read_bytes()[:200])
    with pytest.raises(BeamboxError, match="cannot be read as a tar archive"):
        layout_frames(str(broken), "train")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BeamboxError, match="holds no frame; expected training/label_2"):
        layout_frames(str(tmp_path / "empty"), "train")


def test_kittis_own_layouts_draw_from_the_train_split() -> None:
    path = data_dir() / "kitti_labels.tar.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    assert len(layout_frames(str(path), "train")) == 3712
    frame = simulate_frame(0, 0, layout=f"kitti:{path}")
    assert len(frame) > 8000
