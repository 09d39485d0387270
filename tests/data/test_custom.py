"""Data of one's own: formats, axes, heights, classes, splits, and errors that name file and key."""

from __future__ import annotations

import csv
import json
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.box_files import CAMERA_AT_THE_SENSOR
from beambox.data.custom import CustomSource
from beambox.data.kitti_calibration import format_calibration
from beambox.data.kitti_text import format_labels
from beambox.data.open_dataset import open_dataset
from beambox.data.source import FrameSource
from beambox.structures import Labels
from oracles.own_data import SENSOR_HEIGHT, scene, write_pandaset, write_sweep
from oracles.paths import ROOT

COLUMNS = ("name", "x", "y", "z", "l", "w", "h", "yaw")
SHIFT = SENSOR_HEIGHT - 1.73


def test_custom_frames_stand_on_kitti_ground(tmp_path: Path) -> None:
    source = CustomSource(write_pandaset(tmp_path))
    assert isinstance(source, FrameSource)
    assert list(source.ids) == ["00", "01", "02"] and source.classes == ("Car",)
    frame = source[1]
    points, boxes = scene(1)
    assert frame.id == "01" and frame.labels is not None and frame.calibration is None
    assert frame.labels.attributes is None
    np.testing.assert_allclose(frame.points[:, :2], points[:, :2])
    np.testing.assert_allclose(frame.points[:, 2], points[:, 2] + SHIFT, atol=1e-5)
    np.testing.assert_allclose(frame.labels.boxes[:, 2], boxes[:, 2] + SHIFT, atol=1e-4)
    np.testing.assert_allclose(frame.labels.boxes[:, 6], boxes[:, 6], atol=1e-4)
    assert frame.plane is not None and float(-frame.plane[3] / frame.plane[2]) == pytest.approx(-1.73, abs=0.05)
    again = pickle.loads(pickle.dumps(source))[1]
    assert torch.equal(again.points, frame.points)


def test_without_a_sensor_height_z_stays(tmp_path: Path) -> None:
    frame = CustomSource(write_pandaset(tmp_path, 1, "min_points: 0\n"))[0]
    np.testing.assert_allclose(frame.points[:, 2], scene(0)[0][:, 2])


def test_axes_turn_points_and_boxes_together(tmp_path: Path) -> None:
    config = write_pandaset(tmp_path, 1, 'axes: "x: right, y: forward"\n')
    points, boxes = scene(0)
    turned = np.column_stack((-points[:, 1], points[:, 0], points[:, 2:]))  # x right = -left, y forward
    write_sweep(tmp_path / "velodyne" / "00.bin", turned)
    lines = [
        f"Car {-y:.5f} {x:.5f} {z:.5f} {length} {w} {h} {yaw + math.pi / 2:.5f}" for x, y, z, length, w, h, yaw in boxes
    ]
    (tmp_path / "boxes" / "00.txt").write_text("\n".join(lines), encoding="utf-8")
    frame = CustomSource(config)[0]
    assert frame.labels is not None
    np.testing.assert_allclose(frame.points, points, atol=1e-5)
    np.testing.assert_allclose(frame.labels.boxes, boxes, atol=1e-4)


def rewrite(root: Path, config: str, **lines: str) -> Path:
    """Replace keys of the YAML file."""
    kept = [line for line in config.splitlines() if line.split(":")[0] not in lines]
    path = root / "data.yaml"
    path.write_text("\n".join([*kept, *(f"{key}: {value}" for key, value in lines.items() if value)]), encoding="utf-8")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> tuple[Path, str]:
    return tmp_path, write_pandaset(tmp_path).read_text(encoding="utf-8")


def equal_boxes(actual: CustomSource, wanted: CustomSource) -> None:
    for i in range(len(wanted)):
        a, b = actual.labels(i), wanted.labels(i)
        assert a is not None and b is not None and a.names == b.names
        np.testing.assert_allclose(a.boxes, b.boxes, atol=2e-3)


def test_every_format_gives_the_same_boxes(folder: tuple[Path, str]) -> None:
    root, config = folder
    wanted = CustomSource(root / "data.yaml")
    rows, once = [], []
    for i, name in enumerate(wanted.ids):
        boxes = scene(i)[1].tolist()
        rows += [{"frame": name, "name": "Car", **dict(zip(COLUMNS[1:], box))} for box in boxes]
        once.append({"frame_id": name, "annos": {"names": ["Car"] * len(boxes), "boxes_3d": boxes}})
        own = [{key: row[key] for key in COLUMNS} for row in rows if row["frame"] == name]
        (root / "json").mkdir(exist_ok=True)
        (root / "json" / f"{name}.json").write_text(json.dumps(own), encoding="utf-8")
        labels = Labels(torch.tensor(boxes), ("Car",) * len(boxes))
        (root / "label_2").mkdir(exist_ok=True)
        (root / "calib").mkdir(exist_ok=True)
        text = format_labels(labels, CAMERA_AT_THE_SENSOR).replace(".00 ", ".0000 ")
        (root / "label_2" / f"{name}.txt").write_text(text, encoding="utf-8")
        (root / "calib" / f"{name}.txt").write_text(format_calibration(CAMERA_AT_THE_SENSOR), encoding="utf-8")
    with (root / "all.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["yaw", "extra", *COLUMNS[:-1], "frame"])
        writer.writeheader()
        writer.writerows({"extra": "?", **row} for row in rows)
    (root / "all.json").write_text(json.dumps([{**row, "box": None} for row in rows]), encoding="utf-8")
    (root / "once.json").write_text(json.dumps({"frames": once}), encoding="utf-8")
    for keys in (
        {"labels": "all.csv", "format": ""},
        {"labels": "all.json", "format": ""},
        {"labels": "once.json", "format": "once"},
        {"labels": "json/{frame}.json", "format": "json"},
    ):
        equal_boxes(CustomSource(rewrite(root, config, **keys)), wanted)
    for calibration in ("", "calib/{frame}.txt", "calib/00.txt"):
        keys = {"labels": "label_2/{frame}.txt", "format": "kitti", "calibration": calibration}
        source = CustomSource(rewrite(root, config, **keys))
        for i in range(3):
            a, b = source.labels(i), wanted.labels(i)
            assert a is not None and b is not None
            np.testing.assert_allclose(a.boxes, b.boxes, atol=0.011)  # KITTI's text has two decimals


def test_what_detect_writes_can_be_read_as_labels(folder: tuple[Path, str]) -> None:
    root, config = folder
    (root / "found").mkdir()
    box = dict(zip(COLUMNS, ("Car", 1, 2, 3, 4, 2, 1.5, 0.5)))
    (root / "found" / "00.json").write_text(json.dumps({"frame": "00", "detections": [{**box, "score": 0.9}]}))
    source = CustomSource(rewrite(root, config, labels="found/{frame}.json", format=""))
    labels = source.labels(0)
    assert labels is not None and len(labels) == 1
    assert source.labels(1) is None


def test_classes_are_merged_and_left_out(folder: tuple[Path, str]) -> None:
    root, config = folder
    path = root / "boxes" / "00.txt"
    text = path.read_text(encoding="utf-8").replace("Car", "Pickup_Truck", 2).replace("Car", "Cones", 1)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BeamboxError, match=r'00\.txt, line 2: neither `classes` nor `ignore` names the class "Pick'):
        CustomSource(root / "data.yaml").labels(0)
    yaml = rewrite(root, config, classes="{Vehicle: [Car, Pickup_Truck]}", ignore='["*"]')
    labels = CustomSource(yaml).labels(0)
    assert labels is not None and set(labels.names) == {"Vehicle"} and len(labels) == 7


def test_range_and_fewest_points_leave_boxes_out(folder: tuple[Path, str]) -> None:
    root, config = folder
    path = root / "boxes" / "00.txt"
    path.write_text(path.read_text(encoding="utf-8") + "Car 5 5 30 4 2 1.5 0\n", encoding="utf-8")
    yaml = rewrite(root, config, range="25", min_points="1")
    cropped, whole = CustomSource(yaml)[0], CustomSource(yaml, whole=True)[0]
    assert cropped.labels is not None and whole.labels is not None
    assert cropped.points[:, :2].abs().max() <= 25 < whole.points[:, :2].abs().max()
    assert cropped.labels.boxes[:, :2].abs().max() <= 25 < whole.labels.boxes[:, :2].abs().max()
    assert whole.labels.boxes[-1, 2] > 20 and not (cropped.labels.boxes[:, 2] > 20).any()


def test_splits_are_lists_of_names(folder: tuple[Path, str]) -> None:
    root, config = folder
    (root / "val.txt").write_text("02\n00\n", encoding="utf-8")
    yaml = rewrite(root, config, splits="{val: val.txt}")
    assert list(CustomSource(yaml, "val").ids) == ["02", "00"]
    assert isinstance(open_dataset(yaml, "val"), CustomSource)
    with pytest.raises(BeamboxError, match=r'has no split "vale" \(did you mean "val"\?\)'):
        CustomSource(yaml, "vale")
    (root / "val.txt").write_text("02\n02\n", encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"val\.txt must name each frame once, but names 02 again"):
        CustomSource(yaml, "val")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"clases": "[Car]"}, r'data\.yaml: unknown key "clases" \(did you mean "classes"\?\)'),
        ({"points": "velodyne"}, r"points must contain \{frame\}"),
        ({"format": ""}, r"format must say how boxes/\{frame\}\.txt is written"),
        ({"format": "voc"}, r"format: Input should be 'kitti', 'once', 'pandaset', 'csv', 'json', 'openpcdet'"),
        ({"classes": "{}"}, "classes must name at least one class"),
        ({"classes": "{A: Car, B: Car}"}, "the name 'Car' stands in A and in B"),
        ({"axes": '"x: forward, y: up"'}, "z must lead up or down"),
        ({"axes": '"x: forth, y: up"'}, 'unknown direction "forth"'),
        ({"range": "[0, 0, -1, 1]"}, "range is x0, y0, x1, y1 with x0 < x1"),
        ({"ground_slope": "{left: 3}"}, "ground_slope.left: Input should be less than or equal to 0.3"),
        ({"ground_slope": "{right: 0}"}, "ground_slope.right: Extra inputs are not permitted"),
        ({"sensor_height": "high"}, "sensor_height: Input should be a valid number"),
        ({"labels": "all.txt"}, r"boxes in pandaset format come as one file per frame"),
        ({"points": "none/{frame}.bin"}, r"none, the folder of the sweeps, is not there"),
        ({"points": "boxes/{frame}.pcd"}, r"holds no sweep \*\.pcd"),
    ],
)
def test_descriptions_that_are_wrong(folder: tuple[Path, str], keys: dict[str, str], message: str) -> None:
    root, config = folder
    (root / "all.txt").write_text("", encoding="utf-8")
    with pytest.raises(BeamboxError, match=message) as caught:
        CustomSource(rewrite(root, config, **keys))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Car 1 2 3", r"00\.txt, line 1: expected `class x y z l w h yaw`, got 4 columns"),
        ("Car 1 2 3 4 5 6 left", r"00\.txt, line 1: expected numbers x y z l w h yaw"),
        ("Car 1 2 3 4 -5 6 0", r"00\.txt, line 1: expected finite numbers and sizes"),
        ("Car 1 2 nan 4 5 6 0", r"00\.txt, line 1: expected finite numbers and sizes"),
    ],
)
def test_broken_box_lines_are_named(folder: tuple[Path, str], text: str, message: str) -> None:
    root, _ = folder
    (root / "boxes" / "00.txt").write_text(text, encoding="utf-8")
    with pytest.raises(BeamboxError, match=message):
        CustomSource(root / "data.yaml")[0]


@pytest.mark.parametrize(
    ("name", "text", "kind", "message"),
    [
        ("a.csv", "name,x,y,z,l,w,height\n", "", r"a\.csv, line 1: there is no column `yaw`"),
        ("a.csv", "", "", r"a\.csv is empty"),
        ("a.csv", "name,x,y,z,l,w,h,yaw\nCar,1,2,3,4,5,6,0\n", "", r"a\.csv, line 2: one file for all frames needs"),
        ("a.json", "[", "", r"a\.json is not valid JSON"),
        ("a.json", "{}", "", r"a\.json: expected a list of boxes, got dict"),
        ("a.json", '[{"name": "Car"}]', "", r"a\.json, \[0\]: there is no column `x`"),
        ("a.json", '{"frames": [{}]}', "once", r"a\.json, frames\[0\]: the key `frame_id` is missing"),
        (
            "a.json",
            '{"frames": [{"frame_id": 1, "annos": {"names": ["Car"], "boxes_3d": [[1, 2]]}}]}',
            "once",
            r"a\.json, frames\[0\]\.annos\.boxes_3d\[0\]: expected 7 numbers",
        ),
    ],
)
def test_broken_tables_are_named(folder: tuple[Path, str], name: str, text: str, kind: str, message: str) -> None:
    root, config = folder
    (root / name).write_text(text, encoding="utf-8")
    with pytest.raises(BeamboxError, match=message):
        CustomSource(rewrite(root, config, labels=name, format=kind))


def test_missing_sweep_is_named(folder: tuple[Path, str]) -> None:
    root, _ = folder
    source = CustomSource(root / "data.yaml")
    (root / "velodyne" / "02.bin").unlink()
    with pytest.raises(MissingFileError, match=r"velodyne/02\.bin is not there, the sweep of frame 02"):
        source[2]
    with pytest.raises(MissingFileError, match="is not there; give a data set's folder"):
        open_dataset(root / "none")


OPEN_CUSTOM = """
import resource, sys, time
import numpy, torch
from beambox.data.custom import CustomSource
start = time.process_time()
source = CustomSource(sys.argv[1], "train")
seconds = time.process_time() - start
print(len(source), source.ids[-1], seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux only")
def test_custom_index_of_a_million_frames_opens_fast_and_small(folder: tuple[Path, str]) -> None:
    root, config = folder
    (root / "train.txt").write_text("".join(f"drive_{k // 1000:04d}/{k:06d}\n" for k in range(10**6)))
    yaml = rewrite(root, config, splits="{train: train.txt}")
    env = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-c", OPEN_CUSTOM, str(yaml)]
    output = subprocess.run(command, capture_output=True, text=True, check=True, env=env).stdout.split()
    assert output[:2] == ["1000000", "drive_0999/999999"]
    assert float(output[2]) < 10, f"{output[2]} s of one core"
    assert float(output[3]) < 1e9, f"{output[3]} bytes"
