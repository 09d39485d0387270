"""Detections, labels and frames as values: sequences that can be compared, shown, converted and read back."""

from __future__ import annotations

import base64
import io
import json
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from beambox import BeamboxError, Detection, Detections, Frame, Labels
from beambox.data.box_files import parse_box_file
from beambox.data.kitti import parse_calibration
from beambox.structures import ImageAttributes, Label
from oracles.tiny_detector import CALIBRATION_TEXT

BOXES = np.array([[10.0, 2, -1, 4, 2, 1.5, 0.5], [20, -3, -1, 0.8, 0.6, 1.7, 0], [30, 0, -1, 3.9, 1.6, 1.5, 3]], "f4")
CALIBRATION = parse_calibration(CALIBRATION_TEXT)


def found(scores: tuple[float, ...] = (0.9, 0.5, 0.3)) -> Detections:
    return Detections(BOXES, list(scores), [0, 1, 0], ["Car", "Pedestrian"], "000007")


def labels() -> Labels:
    return Labels(BOXES, ["Car", "Pedestrian", "Van"])


VALUES = {"detections": found(), "labels": labels(), "frame": Frame(np.arange(12, dtype="f4").reshape(3, 4), "a")}


def entries(value: Detections | Labels | Frame) -> list[object]:
    return [one.tolist() if isinstance(one, torch.Tensor) else one for one in value]


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_values_index_as_lists_do(value: Detections | Labels | Frame) -> None:
    """The oracle is a list of the entries, indexed by Python and NumPy."""
    plain = entries(value)
    assert len(value) == len(plain) == 3
    for at in (0, 2, -1, np.int64(1), torch.tensor(1)):
        one = value[at]
        assert (one.tolist() if isinstance(one, torch.Tensor) else one) == plain[int(at)]
    for cut in (slice(1, None), slice(None, None, -1), slice(5, 9), slice(None, None, 2)):
        assert entries(value[cut]) == plain[cut]
    for mask in ([True, False, True], np.array([True, False, True]), torch.tensor([True, False, True])):
        assert entries(value[mask]) == [plain[0], plain[2]]
    for places in ([2, 0, 0], np.array([2, 0, 0], np.uint8), torch.tensor([-1, 0, -3])):
        assert entries(value[places]) == [plain[2], plain[0], plain[0]]
    assert len(value[[]]) == 0 and type(value[[]]) is type(value)


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
@pytest.mark.parametrize(
    ("index", "kind"),
    [
        (3, IndexError), (-4, IndexError), ([0, 3], IndexError),
        ([True], BeamboxError), (1.0, BeamboxError), ("Car", BeamboxError), (True, BeamboxError),
        (torch.tensor(True), BeamboxError), ([[0, 1]], BeamboxError), ([0.5], BeamboxError), (None, BeamboxError),
    ],
)  # fmt: skip
def test_wrong_indices_are_refused(value: Detections, index: object, kind: type[Exception]) -> None:
    with pytest.raises(kind):
        value[index]  # type: ignore[index]


def test_an_entry_has_what_one_reads_in_a_loop() -> None:
    first = found()[0]
    assert isinstance(first, Detection)
    assert (first.name, first.class_id, first.frame_id) == ("Car", 0, "000007")
    assert first.score == pytest.approx(0.9) and first.box == tuple(BOXES[0].tolist())
    assert labels()[1] == Label("Pedestrian", tuple(BOXES[1].tolist()))


def test_equality_compares_every_value_and_every_field() -> None:
    assert found() == found() and found() != found((0.9, 0.5, 0.2)) and found() != found()[:2] and found() != 3
    assert found() != Detections(BOXES, [0.9, 0.5, 0.3], [0, 1, 0], ["Car", "Pedestrian"], "000008")
    assert labels() == labels() and labels() != labels()[::-1]
    other = ImageAttributes(torch.zeros(3), torch.zeros(3).long(), torch.zeros(3), torch.zeros(3, 4))
    assert labels() != Labels(BOXES, labels().names, other) == Labels(BOXES, labels().names, other)
    points = torch.ones(2, 4)
    assert Frame(points, labels=labels()) == Frame(points.clone(), labels=labels()) != Frame(points)
    for value in VALUES.values():
        with pytest.raises(TypeError, match="unhashable"):
            hash(value)


def test_repr_is_one_short_line_whatever_the_names() -> None:
    assert repr(found()) == "Detections(3: 2 Car, 1 Pedestrian; best 0.90; frame 000007)"
    assert repr(Detections.empty()) == "Detections(0: nothing)"
    assert repr(labels()) == "Labels(3: 1 Car, 1 Pedestrian, 1 Van)"
    assert repr(VALUES["frame"]) == "Frame(a: 3 points with 4 columns)"
    assert len(repr(Labels(BOXES, ["x" * 10_000, "y", "z"]))) < 200
    assert len(repr(Frame(torch.zeros(0, 4), "n" * 10_000))) < 200


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_notebooks_show_a_picture_from_above(value: Detections) -> None:
    page = value._repr_html_()
    code = re.search(r'src="data:image/png;base64,([^"]+)"', page)
    assert code is not None
    assert min(Image.open(io.BytesIO(base64.b64decode(code.group(1)))).size) > 100


def test_names_are_escaped_in_notebooks() -> None:
    page = Detections(BOXES[:1], [0.5], [0], ["<script>alert(1)</script>"])._repr_html_()
    assert "<script>" not in page and "&lt;script&gt;" in page


def test_arrays_and_lists_are_accepted_and_checked() -> None:
    value = found()
    assert value.boxes.dtype == torch.float32 and value.class_ids.dtype == torch.int64 and value.classes[0] == "Car"
    with pytest.raises(BeamboxError, match="`class_ids` must hold whole numbers, got float64"):
        Detections(BOXES, [1, 1, 1], [0.0, 1.0, 0.0], ["Car", "Van"])
    with pytest.raises(BeamboxError, match="`boxes` must hold numbers"):
        Detections("boxes", [], [], [])
    with pytest.raises(BeamboxError, match='got the text "Car"'):
        Detections(BOXES[:1], [1], [0], "Car")
    with pytest.raises(BeamboxError, match='one name per box, got the text "Car"'):
        Labels(BOXES[:1], "Car")
    assert not hasattr(value, "labels")
    assert Frame(np.zeros((2, 5))).points.dtype == torch.float32
    assert len(Detections([], [], [], ["Car"])) == 0


def test_merge_joins_classes_by_name_and_puts_the_best_first() -> None:
    other = Detections(BOXES[:2] + 1, [0.7, 0.1], [1, 0], ["Van", "Car"], "000007")
    both = Detections.merge([found(), other])
    assert both.classes == ("Car", "Pedestrian", "Van") and both.frame_id == "000007"
    assert both.names == ["Car", "Car", "Pedestrian", "Car", "Van"]
    assert both.scores.tolist() == pytest.approx([0.9, 0.7, 0.5, 0.3, 0.1])
    assert torch.equal(both.boxes[1], other.boxes[0])
    assert Detections.merge([]) == Detections.empty()
    assert Detections.merge([found(), Detections.empty()]).frame_id == ""


def test_selections_by_class_and_score() -> None:
    assert found().of_classes("Car").scores.tolist() == pytest.approx([0.9, 0.3])
    assert len(found().of_classes(["Pedestrian", "Car"])) == 3
    with pytest.raises(BeamboxError, match=r'no class "Carr" \(did you mean "Car"\?\)'):
        found().of_classes("Carr")
    assert found().above(0.5).names == ["Car", "Pedestrian"]
    assert labels().of_classes("Van").names == ("Van",), "a text is one class, not a set of letters"
    assert not len(Labels(BOXES[:1], ["a"]).of_classes("Van"))


def test_distances_and_corners() -> None:
    assert found().distances.tolist() == pytest.approx([math.sqrt(105), math.sqrt(410), math.sqrt(901)])
    assert labels().corners.shape == (3, 8, 3)
    straight = found().corners[1]
    assert straight[0].tolist() == pytest.approx([20.4, -2.7, -1.85]), "front, left, bottom"


def test_json_and_csv_are_read_back() -> None:
    assert Detections.from_json(found().to_json("m")) == found()
    assert json.loads(found().to_json("m"))["model"] == "m"
    again = Detections.from_csv(found().to_csv(), frame_id="000007")
    assert again == found()
    assert Labels.from_json(labels().to_json()) == labels() == Labels.from_csv(labels().to_csv())
    odd = Detections(BOXES[:1], [0.5], [0], ['a,"b"\n;é'])
    assert Detections.from_json(odd.to_json()) == odd and Detections.from_csv(odd.to_csv()) == odd


def test_labels_as_csv_are_a_label_file_of_ones_own_data() -> None:
    read = parse_box_file(labels().to_csv(), "csv", "labels.csv")
    assert read.names == labels().names and np.allclose(read.boxes, BOXES, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"detections": [], "classes": ["Car"]', "is not valid JSON"),
        ("[" * 100_000, "nested too deeply"),
        ("[]", 'a list under "detections"'),
        ('{"detections": {}}', 'a list under "detections"'),
        ('{"detections": []}', 'under "classes"'),
        ('{"detections": [], "classes": "Car"}', 'under "classes"'),
        ('{"detections": [3], "classes": []}', "entry 1: expected name, score"),
        ('{"detections": [{"name": "Car"}], "classes": []}', "entry 1: expected name, score"),
    ],
)
def test_broken_json_is_refused_by_place(text: str, message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        Detections.from_json(text)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e400", "true", '"x"', "[1]", "1e39", "1" + "0" * 400])
def test_boxes_that_are_no_numbers_are_refused(value: str) -> None:
    text = found()[:1].to_json().replace('"score": 0.9', f'"score": {value}')
    with pytest.raises(BeamboxError, match=r"must be a finite number|expected finite|beyond what a float"):
        Detections.from_json(text)


def test_unknown_classes_and_lines_are_named() -> None:
    with pytest.raises(BeamboxError, match='unknown class "Car"'):
        Detections.from_json(found().to_json().replace('"classes": [\n    "Car"', '"classes": [\n    "Bus"'))
    with pytest.raises(BeamboxError, match="line 3: yaw must be a finite number"):
        Detections.from_csv(found().to_csv().replace("1.7,0.0", "1.7,nan"))
    with pytest.raises(BeamboxError, match="score lacks"):
        Detections.from_csv("name,x,y,z,l,w,h,yaw\n")


def test_kitti_is_read_back() -> None:
    again = Detections.from_kitti(found().to_kitti(CALIBRATION), CALIBRATION, found().classes, "000007")
    assert again.names == found().names and torch.allclose(again.boxes, found().boxes, atol=2e-3)
    back = Labels.from_kitti(labels().to_kitti(CALIBRATION), CALIBRATION)
    assert back.names == labels().names and torch.allclose(back.boxes, labels().boxes, atol=2e-2)


def test_arrays_come_out() -> None:
    arrays = found().to_numpy()
    assert np.array_equal(arrays["boxes"], BOXES) and arrays["names"].tolist() == found().names
    assert arrays["class_ids"].tolist() == [0, 1, 0] and labels().to_numpy()["names"].tolist()[2] == "Van"
    assert VALUES["frame"].to_numpy().shape == (3, 4)


def test_tables_of_pandas() -> None:
    pytest.importorskip("pandas")
    table = found().to_pandas()
    assert list(table.columns) == ["frame", "name", "score", "x", "y", "z", "l", "w", "h", "yaw"]
    assert table["x"].tolist() == [10, 20, 30] and list(found()[:0].to_pandas().columns) == list(table.columns)
    assert labels().to_pandas()["name"].tolist() == ["Car", "Pedestrian", "Van"]
    assert Frame(np.zeros((2, 5))).to_pandas().shape == (2, 5)


def test_supervision_gets_the_boxes_in_the_image() -> None:
    supervision = pytest.importorskip("supervision")
    behind = Detections(BOXES * [-1, 1, 1, 1, 1, 1, 1], [1, 1, 1], [0, 0, 0], ["Car"])
    both = Detections.merge([found(), behind])
    given = both.to_supervision(CALIBRATION, (1242, 375))
    assert isinstance(given, supervision.Detections) and len(given) == 3
    assert given.class_id.tolist() == [0, 1, 0] and given.data["class_name"].tolist() == found().names
    assert given.xyxy[0].tolist() == pytest.approx(CALIBRATION.to_camera(found().boxes, (1242, 375)).image[0].tolist())


@pytest.mark.parametrize(
    ("name", "method", "hint"),
    [
        ("pandas", "to_pandas", r'needs the library pandas, which is not installed: .*pip install "\.\[tables\]"'),
        ("supervision", "to_supervision", "pip install supervision"),
    ],
)
def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch, name: str, method: str, hint: str) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BeamboxError, match=hint):
        getattr(found(), method)(*([CALIBRATION] if name == "supervision" else []))


def test_files_are_written_by_their_endings_and_read_back(tmp_path: Path) -> None:
    frame = Frame(np.random.default_rng(0).uniform(0, 30, (500, 4)).astype("f4") / [1, 1, 10, 30], "000007")
    for name in ("a.json", "b.csv", "c.png", "d.jpg", "e.html"):
        assert found().save(tmp_path / "new" / name, frame=frame).stat().st_size > 100
        labels().save(tmp_path / "labels" / name)
    assert found().save(str(tmp_path / "f.txt"), calibration=CALIBRATION).read_text() == found().to_kitti(CALIBRATION)
    assert frame.save(tmp_path / "000007.bin") and Frame.from_file(tmp_path / "000007.bin") == frame
    assert torch.equal(Frame.from_file(frame.save(tmp_path / "x.npy")).points, frame.points)
    assert Image.open(frame.save(tmp_path / "frame.png")).size[0] > 300
    with pytest.raises(BeamboxError, match="give `calibration` or a `frame`"):
        found().save(tmp_path / "g.txt")
    with pytest.raises(BeamboxError, match=r"ends in \.json, \.csv, \.txt \(KITTI\), \.png, \.jpg or \.html"):
        found().save(tmp_path / "g.xml")
    assert not list(tmp_path.glob("g.*"))


def test_frames_from_arrays_follow_the_rules_for_files() -> None:
    frame = Frame.from_array(np.array([[1.0, 2, 3, 255], [4, 5, 6, 0]]), id="a")
    assert frame.points[:, 3].tolist() == [1.0, 0.0] and frame.id == "a" and "255" in frame.notes[0]
    assert Frame.from_array([[1.0, 2, 3]]).points.tolist() == [[1, 2, 3, 0]]
    assert frame.plot(found()).tobytes() != frame.plot().tobytes()
