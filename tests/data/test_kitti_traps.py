"""KITTI's layout as people really have it: without lists, with other calibrations, labelled without a camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.database import ObjectDatabase
from beambox.data.kitti import KittiSource, write_kitti_frame
from beambox.data.kitti_calibration import parse_calibration
from beambox.data.kitti_splits import kitti_splits, write_kitti_splits
from beambox.data.kitti_text import format_labels, parse_labels
from beambox.geometry import Calibration
from beambox.infer.inputs import read_sweep
from beambox.structures import Frame, Labels
from oracles.paths import data_dir

P = "7e2 0 6e2 45 0 7e2 1.8e2 0.2 0 0 1 0.003"
TR = "0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27"
EYE = "1 0 0 0 1 0 0 0 1"
EXPECTED = Calibration(
    torch.tensor([float(word) for word in P.split()]).reshape(3, 4),
    torch.eye(3),
    torch.tensor([float(word) for word in TR.split()]).reshape(3, 4),
)


def make(root: Path, frames: int = 3, box: str = "500 100 600 200", scale: float = 1.0, name: str = "Car") -> Path:
    """Write frames of one car each; the image box and the intensity as asked."""
    rng = np.random.default_rng(0)
    for kind in ("velodyne", "label_2", "calib"):
        (root / "training" / kind).mkdir(parents=True)
    for k in range(frames):
        car = np.array([6.0 + k, 1, -1]) + rng.uniform(-0.5, 0.5, (60, 3)) * (3.9, 1.6, 1.5)
        points = np.column_stack((car, rng.uniform(0, 1, 60)))
        points[:, 3] = np.round(points[:, 3] * 255) if scale != 1 else points[:, 3]
        points.astype("<f4").tofile(root / f"training/velodyne/{k:06d}.bin")
        line = f"{name} 0 0 0 {box} 1.5 1.6 3.9 -1 {1.75 - 0.08} {6 + k - 0.27} {-np.pi / 2:.4f}\n"
        (root / f"training/label_2/{k:06d}.txt").write_text(line, encoding="utf-8")
        (root / f"training/calib/{k:06d}.txt").write_text(f"P2: {P}\nR0_rect: {EYE}\nTr_velo_to_cam: {TR}\n")
    return root


# ---------------------------------------------------------------- lists


def test_a_named_split_without_lists_is_refused(tmp_path: Path) -> None:
    """The official download has no ImageSets; every name gave every frame, so training and validation were one."""
    make(tmp_path)
    for split in ("train", "val", "trainval"):
        with pytest.raises(
            MissingFileError, match=r"`beambox data splits .*writes KITTI's usual lists of 3712 and 3769"
        ):
            KittiSource(tmp_path, split)
    assert len(KittiSource(tmp_path, "all")) == 3
    (tmp_path / "ImageSets").mkdir()
    with pytest.raises(MissingFileError, match=r"val\.txt is not there"):
        KittiSource(tmp_path, "val")


def test_the_usual_lists_are_the_usual_lists() -> None:
    lists = kitti_splits()
    assert {name: len(names) for name, names in lists.items()} == {
        "train": 3712, "val": 3769, "trainval": 7481, "test": 7518,
    }  # fmt: skip
    assert sorted(lists["train"] + lists["val"]) == lists["trainval"]
    assert lists["train"][:4] == ["000000", "000003", "000007", "000009"] and lists["val"][:3] == [
        "000001",
        "000002",
        "000004",
    ]
    for name in ("train", "val"):
        own = (data_dir("kitti") / "ImageSets" / f"{name}.txt").read_text(encoding="utf-8").split()
        assert set(own) <= set(lists[name])


def test_lists_are_written_for_kitti_alone(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="expected KITTI's layout"):
        write_kitti_splits(tmp_path)
    folder = tmp_path / "training" / "velodyne"
    folder.mkdir(parents=True)
    for name in kitti_splits()["trainval"]:
        (folder / f"{name}.bin").touch()
    assert write_kitti_splits(tmp_path) == {"train": 3712, "val": 3769, "trainval": 7481}
    assert len(KittiSource(tmp_path, "val")) == 3769
    assert write_kitti_splits(tmp_path)["val"] == 3769  # again, nothing to change
    (folder / "000000.bin").unlink()
    with pytest.raises(BeamboxError, match="holds 7480 of KITTI's 7481"):
        write_kitti_splits(tmp_path)
    with pytest.raises(BeamboxError, match=r"train\.txt is there already and names other frames"):
        write_kitti_splits(tmp_path, partial=True)
    (folder / "scan1.bin").touch()
    with pytest.raises(BeamboxError, match="which is none of KITTI's frames"):
        write_kitti_splits(tmp_path, partial=True)


@pytest.mark.parametrize("name", ["../../x/authorized_keys", "a/b", "..", "a\\b"])
def test_names_in_lists_stay_in_the_folder(tmp_path: Path, name: str) -> None:
    make(tmp_path)
    (tmp_path / "ImageSets").mkdir()
    (tmp_path / "ImageSets" / "val.txt").write_text(f"000000\n{name}\n", encoding="utf-8")
    with pytest.raises(BeamboxError, match="a name must be a plain file name"):
        KittiSource(tmp_path, "val")
    with pytest.raises(BeamboxError, match="a name must be a plain file name"):
        KittiSource(tmp_path, name)
    with pytest.raises(BeamboxError, match="a name must be a plain file name"):
        write_kitti_frame(tmp_path, Frame(torch.zeros(1, 4), name))
    assert not list(tmp_path.rglob("authorized_keys*"))


# ---------------------------------------------------------------- calibration

OTHER_FORMS = {
    "odometry": "".join(f"P{k}: {P}\n" for k in range(4)) + f"Tr: {TR}\n",
    "tracking": f"P2: {P}\nR_rect {EYE}\nTr_velo_cam {TR}\n",
    "raw": f"calib_time: 09-Jan-2012\nP_rect_02: {P}\nR_rect_00: {EYE}\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\n",
    "tabs": f"P2:\t{P}\nR0_rect:\t{EYE}\nTr_velo_to_cam:\t{TR}\n",
    "no blank": f"P2:{P}\nR0_rect:{EYE}\nTr_velo_to_cam:{TR}\n",
    "windows": f"P2: {P}\r\nR0_rect: {EYE}\r\nTr_velo_to_cam: {TR}\r\n",
    "commas": f"P2: {P}\nR0_rect: {EYE}\nTr_velo_to_cam: {TR}\n".replace(" ", ", ").replace(":,", ":"),
    "four by four": f"P2: {P} 0 0 0 1\nR0_rect: 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\nTr_velo_to_cam: {TR} 0 0 0 1\n",
    "repeated": f"P2: {P}\nP2: {P}\nR0_rect: {EYE}\nTr_velo_to_cam: {TR}\n",
}


@pytest.mark.parametrize("form", OTHER_FORMS)
def test_calibrations_of_other_benchmarks_and_tools(form: str) -> None:
    read = parse_calibration(OTHER_FORMS[form])
    for key in ("p2", "r0", "velo_to_cam"):
        torch.testing.assert_close(getattr(read, key), getattr(EXPECTED, key), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("tr", "p2", "message"),
    [
        (TR.replace("-0.27", "nan"), P, "expected finite numbers"),
        (TR.replace("-0.27", "1e999"), P, "expected finite numbers"),
        (TR.replace("-0.27", "-270"), P, "are these millimetres"),
        ("0 -1000 0 0 0 0 -1000 -80 1000 0 0 -270", P, "expected rotations"),
        ("0 1 0 0 0 0 -1 -0.08 1 0 0 -0.27", P, "expected rotations"),  # mirrored
        ("0 0 0 0 0 0 0 0 0 0 0 0", P, "expected rotations"),
        ("1 0 0 0 0 1 0 0 0 0 1 0", P, "a placeholder is 0 -1 0 0 0 0 -1 0 1 0 0 0"),
        ("1 0 0 0 0 0 -1 0 0 1 0 0", P, "must look along the LiDAR's x"),  # a camera that looks to the left
        (TR, "0 " * 12, "positive focal lengths"),
        (TR, P.replace("0 0 1 0.003", "0 0 0 1"), "a last row 0 0 1 t"),
        (TR, "1e20 0 6e2 45 0 7e2 1.8e2 0.2 0 0 1 0.003", "expected pixels"),
        (TR + " 0 0 1 0", P, "expected 12 numbers"),
        (TR, P + "\nP2: " + P.replace("7e2", "8e2"), "`P2` stands in line 1 with other numbers"),
    ],
)
def test_what_can_be_no_calibration_is_refused(tr: str, p2: str, message: str) -> None:
    with pytest.raises(BeamboxError, match=message) as caught:
        parse_calibration(f"P2: {p2}\nR0_rect: {EYE}\nTr_velo_to_cam: {tr}\n", "calib/000000.txt")
    assert str(caught.value).startswith("calib/000000.txt") and "\n" not in str(caught.value)


# ---------------------------------------------------------------- intensity


def test_training_and_detection_see_the_same_intensity(tmp_path: Path) -> None:
    """0..255 in KITTI's layout: the training source gave 254, `detect` 0.996."""
    make(tmp_path, scale=255)
    trained = KittiSource(tmp_path, "all")[0]
    seen = read_sweep(tmp_path / "training/velodyne/000000.bin")
    assert torch.equal(trained.points, seen.points) and 0.9 < float(seen.points[:, 3].max()) <= 1
    assert "intensity divided by 255" in trained.notes


# ---------------------------------------------------------------- labels made without a camera


@pytest.mark.parametrize("box", ["0 0 0 0", "-1 -1 -1 -1", "0.00 0.00 0.00 0.00"])
def test_without_image_boxes_nothing_is_filtered_by_the_image(tmp_path: Path, box: str) -> None:
    source = KittiSource(make(tmp_path, box=box), "all", fov=True)
    frame = source[0]
    assert len(frame) == 60 and frame.image_size is None and "all image boxes are 0" in frame.notes[0]
    assert frame.labels is not None and frame.labels.names == ("Car",) and frame.labels.attributes is None
    assert ObjectDatabase.build(source, ["Car"]).counts() == {"Car": 3}
    assert read_sweep(tmp_path / "training/velodyne/000000.bin").image_size is None


def test_some_image_boxes_keep_the_levels(tmp_path: Path) -> None:
    make(tmp_path, box="0 0 0 0")
    path = tmp_path / "training/label_2/000002.txt"
    path.write_text(path.read_text(encoding="utf-8").replace("0 0 0 0 1.5", "500 100 600 200 1.5"), encoding="utf-8")
    source = KittiSource(tmp_path, "all")
    assert source.has_image_boxes and source[0].image_size == (1242, 375)
    assert ObjectDatabase.build(source, ["Car"]).counts() == {"Car": 1}


@pytest.mark.parametrize("name", ["my car", "50% off", "#7", "dontcare", "Straße"])
def test_what_is_written_is_read_whatever_classes_are_called(tmp_path: Path, name: str) -> None:
    labels = parse_labels("Car 0 0 0 500 100 600 200 1.5 1.6 3.9 -1 1.6 6 0\n", EXPECTED)
    named = replace(labels, names=(name,))
    assert parse_labels(format_labels(named, EXPECTED), EXPECTED).names == (name,)
    plain = Labels(labels.boxes, (name,))
    write_kitti_frame(tmp_path, Frame(torch.zeros(3, 4), "1", plain, EXPECTED))
    read = KittiSource(tmp_path, "all")[0].labels
    assert read is not None and read.names == (name,)


def test_regions_that_nobody_labeled_are_told_in_any_case() -> None:
    line = "dontcare -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10\n"
    labels = parse_labels(line, EXPECTED)
    assert len(labels) == 0 and len(labels.ignored_image) == 1


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_encodings_of_labels_and_lists(tmp_path: Path, encoding: str) -> None:
    make(tmp_path, name="Käfer")
    label = tmp_path / "training/label_2/000000.txt"
    label.write_bytes(label.read_text(encoding="utf-8").encode(encoding))
    (tmp_path / "ImageSets").mkdir()
    (tmp_path / "ImageSets/val.txt").write_bytes("000000\n".encode(encoding))
    if encoding == "utf-8-sig":
        labels = KittiSource(tmp_path, "val")[0].labels
        assert labels is not None and labels.names == ("Käfer",)
        return
    with pytest.raises(BeamboxError, match=r"save it as UTF-8"):
        KittiSource(tmp_path, "val")[0]
