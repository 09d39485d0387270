"""Data of one's own as Excel, other tools and tired people write them: read rightly, or refused with the cause."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.custom import CustomSource
from beambox.data.folder import FolderSource
from beambox.data.once import OnceSource, write_once_sequence
from beambox.structures import Frame, Labels

HEAD = "frame,name,x,y,z,l,w,h,yaw\n"
ROW = "000123,Car,1,2,-1,4,2,1.5,0.5\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "velodyne").mkdir()
    np.zeros((9, 4), "<f4").tofile(tmp_path / "velodyne/000123.bin")
    text = "points: velodyne/{frame}.bin\nlabels: a.csv\nclasses: [Car]\n"
    (tmp_path / "data.yaml").write_text(text, encoding="utf-8")
    return tmp_path


def labels_of(root: Path, table: str, encoding: str = "utf-8") -> Labels:
    (root / "a.csv").write_bytes(table.encode(encoding))
    labels = CustomSource(root / "data.yaml").labels(0)
    assert labels is not None
    return labels


@pytest.mark.parametrize(
    ("table", "encoding"),
    [
        (HEAD + ROW, "utf-8"),
        (HEAD + ROW, "utf-8-sig"),
        ((HEAD + ROW).replace(",", ", "), "utf-8"),
        ((HEAD + ROW).replace("\n", "\r\n"), "utf-8"),
        (HEAD.replace("yaw", "yaw_deg") + ROW.replace("0.5\n", "28.64788976\n"), "utf-8"),
        (HEAD.replace("x,y,z,l,w,h", "center_x,center_y,center_z,length,width,height") + ROW, "utf-8"),
        (HEAD + "\n" + ROW + "\n\n", "utf-8"),
        (HEAD.upper() + ROW, "utf-8"),
        (HEAD + '"000123","Car",1,2,-1,4,2,1.5,0.5\n', "utf-8"),
    ],
)
def test_tables_as_tools_write_them(root: Path, table: str, encoding: str) -> None:
    labels = labels_of(root, table, encoding)
    assert labels.names == ("Car",)
    torch.testing.assert_close(labels.boxes, torch.tensor([[1, 2, -1, 4, 2, 1.5, 0.5]]))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (HEAD + ROW.replace("000123", "123"), r'frame "123" of .*a\.csv is no sweep; is it 000123\?'),
        (HEAD + ROW.replace("000123", "000123.bin"), "is it 000123"),
        (HEAD + ROW.replace("000123", "velodyne/000123"), "is it 000123"),
        (HEAD + ROW.replace("000123", "999"), 'none of its 1 frames is a sweep: "999", but sweeps are called 000123'),
        ((HEAD + ROW).replace(",", ";"), "line 1: the columns are parted by semicolons"),
        ((HEAD + ROW).replace(",", "\t"), "parted by tabs"),
        (HEAD + ROW.replace(",0.5", ""), "line 2: expected 9 columns as in the header, got 8"),
        (HEAD + ROW.replace("1,2,", "1,,"), "expected numbers x y z l w h yaw"),
        (HEAD + ROW.replace("1,2,", "1e999,2,"), "expected finite numbers"),
        (HEAD + ROW.replace("1,2,", "9" * 5000 + ",2,"), "expected finite numbers"),
        (HEAD + '"' + "x" * 200_000, "no table of comma-separated values"),
        (HEAD + ROW.replace("Car", "C" * 20_000), "a cell has 20000 letters"),
        ("", "is empty"),
        (HEAD.replace("yaw", "jaw") + ROW, 'no column `yaw` .did you mean "jaw"'),
    ],
)
def test_tables_that_would_train_on_nothing_are_refused(root: Path, table: str, message: str) -> None:
    with pytest.raises(BeamboxError, match=message) as caught:
        labels_of(root, table)
    assert len(str(caught.value)) < 500 and "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_tables_in_other_encodings_are_refused_by_name(root: Path, encoding: str) -> None:
    with pytest.raises(BeamboxError, match=r"a\.csv .*save it as UTF-8"):
        labels_of(root, HEAD + ROW.replace("Car", "Käfer"), encoding)


def test_a_table_may_hold_frames_of_which_the_sweeps_are_elsewhere(root: Path) -> None:
    assert labels_of(root, HEAD + ROW + ROW.replace("000123", "000999")).names == ("Car",)


def test_label_files_called_otherwise_are_refused(root: Path) -> None:
    text = "points: velodyne/{frame}.bin\nlabels: boxes/{frame}.txt\nformat: pandaset\nclasses: [Car]\n"
    (root / "data.yaml").write_text(text, encoding="utf-8")
    (root / "boxes").mkdir()
    (root / "boxes/123.txt").write_text("Car 1 2 -1 4 2 1.5 0\n", encoding="utf-8")
    with pytest.raises(BeamboxError, match=r'none of the 1 label files is called as a sweep: "123", but .* 000123'):
        CustomSource(root / "data.yaml")


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ("{frame}/points.bin", "must stand once in the file's name"),
        ("velodyne/{frame}_{frame}.bin", "must stand once in the file's name"),
        ("velodyne/all.bin", "points must contain {frame}"),
    ],
)
def test_where_frame_may_stand(root: Path, points: str, message: str) -> None:
    (root / "data.yaml").write_text(f"points: '{points}'\nclasses: [Car]\n", encoding="utf-8")
    with pytest.raises(BeamboxError, match=message):
        CustomSource(root / "data.yaml")


@pytest.mark.parametrize(
    "text",
    [
        "points: velodyne/{frame}.bin\nclasses: [Car]\nrange: .inf\n",
        "points: velodyne/{frame}.bin\nclasses: [Car]\nrange: [.nan, 0, 1, 1]\n",
        "points: velodyne/{frame}.bin\nclasses: [Car]\nintensity_scale: .inf\n",
        "points: velodyne/{frame}.bin\nclasses: [Car]\nsensor_height: .nan\n",
        "points: velodyne/{frame}.bin\nclasses: [Car]\nrange: 1" + "0" * 400 + "\n",
        "points: velodyne/{frame}.bin\nclasses: [Car]\nrange: 1" + "0" * 5000 + "\n",
        "points: velodyne/{frame}.bin\nclasses: " + "[" * 3000,
        "points: [velodyne]\nclasses: {1: 2}\n",
        "points: velodyne/{frame}.bin\nclasses: [Car]\nclasses: [Bus]\n",
        'points: "velodyne/{frame}.bin\\0"\nclasses: [Car]\n',
    ],
)
def test_descriptions_that_cannot_be_meant_are_one_line(root: Path, text: str) -> None:
    (root / "data.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"data\.yaml") as caught:
        CustomSource(root / "data.yaml")
    assert len(str(caught.value)) < 600 and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "boxes",
    [
        "[1" + "0" * 400 + "]", "[" * 10_000, '[{"name": "Car", "box": [1, 2, 3, 4, 5, 6, NaN]}]', '[{"name": "Car"}]',
        '[{"name": "Car", "box": [1, 2, 3, 4, 5, 6, 1' + "0" * 400 + "]}]", "[[]]", "7", '{"detections": 3}',
    ],
)  # fmt: skip
def test_json_that_is_no_boxes(root: Path, boxes: str) -> None:
    text = "points: velodyne/{frame}.bin\nlabels: '{frame}.json'\nclasses: [Car]\n"
    (root / "data.yaml").write_text(text, encoding="utf-8")
    (root / "000123.json").write_text(boxes, encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"000123\.json"):
        CustomSource(root / "data.yaml").labels(0)


def test_openpcdet_s_custom_layout_has_the_class_last(tmp_path: Path) -> None:
    for name in ("points", "labels"):
        (tmp_path / name).mkdir()
    np.save(tmp_path / "points/000000.npy", np.zeros((5, 4), "f4"))
    (tmp_path / "labels/000000.txt").write_text("10.0 3.0 -1.0 4.0 1.8 1.5 0.3 Vehicle\n", encoding="utf-8")
    labels = FolderSource(tmp_path)[0].labels
    assert labels is not None and labels.names == ("Vehicle",)
    torch.testing.assert_close(labels.boxes, torch.tensor([[10, 3, -1, 4, 1.8, 1.5, 0.3]]))


def test_boxes_follow_points_out_of_map_coordinates(tmp_path: Path) -> None:
    """Points in UTM are shifted on reading: the labels of the same data must be shifted alike."""
    (tmp_path / "sweeps").mkdir()
    east, north = 450_123.4, 5_400_567.8
    cloud = np.random.default_rng(0).uniform(-20, 20, (500, 4)) + np.array([east, north, 0, 0])
    np.save(tmp_path / "sweeps/a.npy", cloud)
    (tmp_path / "a.json").write_text(
        json.dumps([{"name": "Car", "box": [east + 5, north - 3, 0, 4, 2, 1.5, 0]}]), encoding="utf-8"
    )
    text = "points: sweeps/{frame}.npy\nlabels: '{frame}.json'\nclasses: [Car]\nintensity_scale: 1\n"
    (tmp_path / "data.yaml").write_text(text, encoding="utf-8")
    frame = CustomSource(tmp_path / "data.yaml")[0]
    assert frame.labels is not None
    offset = torch.from_numpy(cloud[0, :2] - [east + 5, north - 3])
    torch.testing.assert_close((frame.points[0, :2] - frame.labels.boxes[0, :2]).double(), offset, atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ["../x", "a/b", "..", ""])
def test_names_of_once_s_frames_and_sequences_stay_in_the_folder(tmp_path: Path, name: str) -> None:
    frame = Frame(torch.zeros(2, 4), "1", Labels(torch.zeros(0, 7), ()))
    write_once_sequence(tmp_path, "000000", [frame])
    with pytest.raises(BeamboxError, match="plain file name"):
        write_once_sequence(tmp_path, name, [frame])
    with pytest.raises(BeamboxError, match="plain file name"):
        write_once_sequence(tmp_path, "000001", [Frame(torch.zeros(2, 4), name)])
    path = tmp_path / "data/000000/000000.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    content["frames"][0]["frame_id"] = name
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(BeamboxError, match="plain file name"):
        OnceSource(tmp_path, "all", labeled=False)


@pytest.mark.parametrize(
    "boxes",
    [[[1, 2, 3, 4, 5, 6]], [[1] * 7, [1] * 6], [[[1] * 7]], [["a"] * 7], [[1e999] * 7], [[10**400] * 7], [1] * 7],
)
def test_once_boxes_of_another_shape_are_refused(tmp_path: Path, boxes: list) -> None:
    folder = tmp_path / "data/000000"
    folder.mkdir(parents=True)
    content = {"frames": [{"frame_id": "1", "annos": {"names": ["Car"] * len(boxes), "boxes_3d": boxes}}]}
    (folder / "000000.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(BeamboxError, match=r"000000\.json"):
        OnceSource(tmp_path, "all")
