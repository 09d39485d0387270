"""`beambox score`: numbers as JSON, and one line for what the user can mend."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from beambox.checks import BeamboxError
from beambox.cli.score import app, parse_overlaps

LABEL = "Car 0 0 0.5 100 100 200 180 1.5 1.6 4 0 1.7 20 0"


def kitti(folder: Path) -> list[str]:
    for name, text in (("label_2", LABEL), ("results", f"{LABEL} 0.9")):
        (folder / name).mkdir()
        (folder / name / "000000.txt").write_text(text, encoding="utf-8")
    return ["kitti", "--labels", str(folder / "label_2"), "--results", str(folder / "results")]


def test_score_kitti_writes_the_documented_json(tmp_path: Path) -> None:
    command = kitti(tmp_path)
    done = CliRunner().invoke(app, [*command, "--iou", "Car=0.5", "--json", str(tmp_path / "out" / "ap.json")])
    assert done.exit_code == 0, done.output
    assert "Car, IoU > 0.50, 1 / 1 / 1 objects" in done.output
    record = json.loads((tmp_path / "out" / "ap.json").read_text(encoding="utf-8"))
    assert record["Car"]["iou"] == 0.5
    assert record["Car"]["3d"]["all"] == [100.0, 100.0, 100.0]
    assert record["Pedestrian"]["3d"]["R40"] == [None, None, None]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["ap.json"]


def test_score_kitti_of_a_list_without_difficulties(tmp_path: Path) -> None:
    command = kitti(tmp_path)
    (tmp_path / "label_2" / "000001.txt").write_text(LABEL, encoding="utf-8")
    (tmp_path / "val.txt").write_text("000000\n", encoding="utf-8")
    done = CliRunner().invoke(
        app, [*command, "--frames", str(tmp_path / "val.txt"), "--no-difficulty", "--classes", "Car"]
    )
    assert done.exit_code == 0, done.output
    assert "every object counts" in done.output and "aos" not in done.output


def test_score_stops_with_one_line(tmp_path: Path) -> None:
    command = kitti(tmp_path)
    (tmp_path / "results" / "000000.txt").unlink()
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1 and "1 of 1 frames have no result file" in done.stderr
    done = CliRunner().invoke(app, ["once", "--annotations", str(tmp_path / "none.json")])
    assert done.exit_code == 2
    assert done.stderr.count("\n") == 1 and "none.json is not there" in done.stderr


def test_score_once_writes_the_documented_json(tmp_path: Path) -> None:
    entry = {"frame_id": "a", "names": ["Car"], "boxes_3d": [[10, 0, -1, 4, 2, 1.5, 0]]}
    content = {"ground_truth": [entry], "predictions": [{**entry, "scores": [0.5]}]}
    (tmp_path / "a.json").write_text(json.dumps(content), encoding="utf-8")
    done = CliRunner().invoke(
        app, ["once", "--annotations", str(tmp_path / "a.json"), "--json", str(tmp_path / "o.json")]
    )
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "o.json").read_text(encoding="utf-8"))
    assert list(record) == ["Vehicle", "Pedestrian", "Cyclist", "mean"]
    assert record["Vehicle"] == {"iou": 0.7, "overall": 100.0, "0-30m": 100.0, "30-50m": 0.0, "50m-inf": 0.0}


@pytest.mark.parametrize("text", ["Car", "Car=x", "=0.5"])
def test_overlaps_that_cannot_be_read(text: str) -> None:
    with pytest.raises(BeamboxError, match="--iou takes CLASS=NUMBER pairs"):
        parse_overlaps(text)


def test_overlaps() -> None:
    assert parse_overlaps("Car=0.5, Pedestrian=0.25") == {"Car": 0.5, "Pedestrian": 0.25}
    assert parse_overlaps("") == {}
