"""Detections on disk: what is written is read back."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch

from beambox import BeamboxError, Detections, Frame
from beambox.data.kitti import parse_calibration
from beambox.infer.results import choose_formats, find_result, read_result, write_results
from oracles.tiny_detector import CALIBRATION_TEXT

FOUND = Detections(
    torch.tensor([[10.0, 1.5, -0.9, 4.1, 1.7, 1.5, 0.25], [20.0, -3.0, -0.8, 0.8, 0.6, 1.8, -1.0]]),
    torch.tensor([0.9, 0.25]),
    torch.tensor([0, 2]),
    ("Car", "Pedestrian", "Cyclist"),
    "000007",
)
FRAME = Frame(torch.zeros(1, 4), "000007", calibration=parse_calibration(CALIBRATION_TEXT), image_size=(1242, 375))


@pytest.mark.parametrize("kind", ["json", "csv", "kitti"])
@pytest.mark.parametrize("found", [FOUND, FOUND[:0]], ids=["two", "none"])
def test_results_are_read_back(tmp_path: Path, kind: str, found: Detections) -> None:
    (path,) = write_results(tmp_path, FRAME, found, [kind], "tiny")
    assert find_result(tmp_path, "000007") == path
    again = read_result(path, FRAME)
    assert again.names == found.names
    assert torch.allclose(again.boxes, found.boxes, atol=2e-3)
    assert torch.allclose(again.scores, found.scores, atol=1e-4)


def test_json_is_documented_and_plain(tmp_path: Path) -> None:
    (path,) = write_results(tmp_path, FRAME, FOUND, ["json"], "tiny")
    content = json.loads(path.read_text(encoding="utf-8"))
    assert list(content) == ["frame", "model", "beambox", "classes", "detections"]
    assert content["model"] == "tiny" and content["classes"] == ["Car", "Pedestrian", "Cyclist"]
    assert content["detections"][0] == {
        "name": "Car", "score": 0.9, "x": 10.0, "y": 1.5, "z": -0.9, "l": 4.1, "w": 1.7, "h": 1.5, "yaw": 0.25,
    }  # fmt: skip


def test_csv_has_a_header_and_one_line_a_detection(tmp_path: Path) -> None:
    (path,) = write_results(tmp_path, FRAME, FOUND, ["csv"], "tiny")
    rows = list(csv.reader(path.open(encoding="utf-8")))
    assert rows[0] == ["frame", "name", "score", "x", "y", "z", "l", "w", "h", "yaw"]
    assert [row[:2] for row in rows[1:]] == [["000007", "Car"], ["000007", "Cyclist"]]


def test_kitti_needs_a_calibration_and_says_what_works_without(tmp_path: Path) -> None:
    with pytest.raises(BeamboxError, match=r"needs the sweep's calibration .* write json or csv instead"):
        write_results(tmp_path, Frame(torch.zeros(1, 4), "a"), FOUND, ["kitti"], "tiny")
    assert not list(tmp_path.iterdir())


def test_names_with_folders_make_folders(tmp_path: Path) -> None:
    (path,) = write_results(tmp_path, FRAME, FOUND, ["json"], "tiny", "one/0")
    assert path == tmp_path / "one" / "0.json" and path.exists()


def test_formats_are_read_from_a_list_and_unknown_ones_refused() -> None:
    assert choose_formats("kitti, JSON,kitti") == ["kitti", "json"]
    with pytest.raises(BeamboxError, match=r'unknown format "jsn" \(did you mean "json"\?\)'):
        choose_formats("jsn")
    with pytest.raises(BeamboxError, match="at least one format of json, csv, kitti"):
        choose_formats(" ,")


def test_files_that_hold_something_else_are_refused(tmp_path: Path) -> None:
    for name, text in (("a.json", "{}"), ("b.json", "not json"), ("c.csv", "x,y\n1,2\n")):
        (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(BeamboxError, match="must hold detections as `beambox detect` writes them"):
            read_result(tmp_path / name, FRAME)
