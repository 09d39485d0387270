"""`beambox track` and `beambox score tracking`, from result files; and the drive 0012 of KITTI's tracking benchmark."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.cli.main import main
from beambox.data.box_files import CAMERA_AT_THE_SENSOR as CAMERA
from beambox.data.kitti_text import format_calibration
from beambox.data.kitti_tracking import format_tracking, parse_tracking
from beambox.track.poses import read_poses
from beambox.track.scoring import score_tracks
from beambox.track.sequence import frame_numbers, stamps_of
from oracles.paths import data_dir

pytest.importorskip("filterpy")


def run(*words: object) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([str(word) for word in words])
    assert not stopped.value.code


def result_files(folder: Path, gap: int | None = None) -> Path:
    """Write KITTI text of another project: one car that drives off at 10 m/s; a frame without boxes has no file."""
    folder.mkdir()
    for k in range(12):
        if k != gap:
            box = torch.tensor([[15.0 + k, 2.0, -0.9, 4.0, 1.7, 1.5, 0.1]])
            rows = format_tracking(k, [0], ["Car"], box, [0.9], CAMERA).split()
            (folder / f"{k:06d}.txt").write_text(" ".join(rows[2:]) + "\n")
    (folder.parent / "calib.txt").write_text(format_calibration(CAMERA))
    return folder


def test_result_files_of_another_project_become_tracks_and_a_gap_is_a_frame_without_boxes(tmp_path: Path) -> None:
    results = result_files(tmp_path / "results", gap=6)
    run("track", "--results", results, "--calib", tmp_path / "calib.txt", "--out", tmp_path / "tracks.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "tracks.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == [f"{k:06d}" for k in range(12)]
    assert [len(line["tracks"]) for line in lines] == [1] * 6 + [0] + [1] * 5
    assert {one["id"] for line in lines for one in line["tracks"]} == {1}
    assert lines[-1]["time"] == pytest.approx(1.1)
    assert lines[-1]["tracks"][0]["vx"] == pytest.approx(10, abs=0.5)


def test_tracks_scored_against_themselves_are_perfect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results, calib = result_files(tmp_path / "results"), tmp_path / "calib.txt"
    run("track", "--results", results, "--calib", calib, "--out", tmp_path / "tracks.txt")
    text = (tmp_path / "tracks.txt").read_text()
    labels = "".join(
        " ".join([*words[:3], "0", "0", *words[5:17]]) + "\n" for words in map(str.split, text.splitlines())
    )
    (tmp_path / "labels.txt").write_text(labels)
    files = ("--labels", tmp_path / "labels.txt", "--results", tmp_path / "tracks.txt", "--calib", calib)
    run("score", "tracking", *files, "--json", tmp_path / "scores.json")
    scores = json.loads((tmp_path / "scores.json").read_text())["Car"]
    assert (scores["hota"], scores["mota"], scores["switches"], scores["objects"]) == (100, 100, 0, 1)
    assert "sAMOTA" in capsys.readouterr().out


def test_who_takes_part_follows_kittis_rules() -> None:
    """A van, an object of unknown occlusion and a DontCare region spare tracks; a small track without partner too."""
    boxes = torch.tensor(
        [[20.0, y, -0.9, 4, 1.7, 1.5, 0] for y in (-8.0, -3.0, 3.0)] + [[90.0, 0, -0.9, 4, 1.7, 1.5, 0]]
    )
    tracks = parse_tracking(format_tracking(0, [1, 2, 3, 4], ["Car"] * 4, boxes, [0.9] * 4, CAMERA), CAMERA)
    rows = [line.split() for line in format_tracking(0, [1, 2], ["Van", "Car"], boxes[:2], [1, 1], CAMERA).splitlines()]
    rows[0][3:5], rows[1][3:5] = ["0", "0"], ["0", "3"]
    image = tracks[0].image[2]
    region = " ".join(f"{value:.2f}" for value in (image[0] - 5, image[1] - 5, image[2] + 5, image[3] + 5))
    text = "".join(" ".join(row[:17]) + "\n" for row in rows)
    labels = parse_tracking(f"{text}0 -1 DontCare -1 -1 -10 {region} -1 -1 -1 -1000 -1000 -1000 -10\n", CAMERA)
    clear = score_tracks([(labels, tracks)], ["Car"]).classes["Car"].clear
    assert (clear.tp, clear.fp, clear.fn) == (0, 0, 0)
    without = parse_tracking(text, CAMERA)
    assert score_tracks([(without, tracks)], ["Car"]).classes["Car"].clear.fp == 1


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("0 1 Car 0 0", "line 1: expected frame, id, type and 14 numbers"),
        ("a 1 Car" + " 0" * 14, 'the frame must be a whole number, got "a"'),
        ("0 1 Car" + " 0" * 13 + " nan", "expected finite metres"),
        ("0 1 Car" + " 1" * 14 + "\n0 1 Car" + " 1" * 14, "frame 0: the identity 1 stands there twice"),
    ],
)
def test_broken_tracking_files_are_refused(text: str, fault: str) -> None:
    with pytest.raises(BeamboxError, match=fault):
        parse_tracking(text, CAMERA)


def test_poses_in_three_forms(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 5 0 1 0 6 0 0 1 7\n0 -1 0 5 1 0 0 6 0 0 1 7\n")
    assert read_poses(path).matrices[1, :3].tolist() == [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]]
    path.write_text(f"# time x y z q\n3.5 5 6 7 0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}\n")
    poses = read_poses(path)
    assert poses.matrices[0, :3] == pytest.approx(np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7]]))
    assert poses.times is not None and poses.times.tolist() == [3.5]
    path.write_text("1 0 0 5 0 1 0 6 0 0 1 7\n")
    # the camera drives 7 m along its z, which is the LiDAR's x
    assert read_poses(path, CAMERA).matrices[0, :3, 3].tolist() == pytest.approx([7, -5, -6])
    path.write_text("1 2 3\n")
    with pytest.raises(BeamboxError, match="line 1: a pose is 12, 16 or 8 numbers, got 3"):
        read_poses(path)


def test_names_that_are_numbers_or_times() -> None:
    assert frame_numbers(["000003", "000007"]) == [3, 7]
    assert frame_numbers(["a", "b"]) == [0, 1]
    assert frame_numbers(["1700000000000000000", "1700000000100000000"]) == [0, 1]
    assert stamps_of(["t/1700000000000000000", "t/1700000000100000000-2"]) == pytest.approx([0, 0.1])
    assert stamps_of(["000001"]) is None


def test_drive_0012_recorded_detections(tmp_path: Path) -> None:
    """The drive's own labels, thinned and shaken, as detections: what remains is the tracker's own doing."""
    archive = data_dir() / "kitti_tracking_0012.tar.xz"
    if not archive.exists():
        pytest.skip(f"{archive} is not there")
    wanted = ("kitti_tracking/0012/calib.txt", "kitti_tracking/0012/label_02.txt")
    with tarfile.open(archive) as files:
        for name in wanted:
            stream = files.extractfile(name)
            assert stream is not None
            (tmp_path / Path(name).name).write_bytes(stream.read())
    from beambox.data.kitti_text import read_calibration
    from beambox.data.kitti_tracking import read_tracking
    from beambox.structures import Detections
    from beambox.track import Tracker

    calibration = read_calibration(tmp_path / "calib.txt")
    labels = read_tracking(tmp_path / "label_02.txt", calibration)
    rng, tracker, text = np.random.default_rng(1), Tracker(), ""
    classes = ("Car", "Pedestrian", "Cyclist")
    for k in range(78):
        truth = labels[k]
        rows = [i for i in range(len(truth)) if truth.names[i] in classes and rng.random() < 0.9]
        boxes = truth.boxes[rows] + rng.normal(0, [0.1, 0.1, 0.05, 0.1, 0.05, 0.05, 0.1], (len(rows), 7))
        ids = torch.tensor([classes.index(truth.names[i]) for i in rows], dtype=torch.int64)
        shown = Detections(torch.from_numpy(boxes).float(), torch.full((len(rows),), 0.8), ids, classes)
        tracks = tracker.update(shown)
        found = tracks.detections
        text += format_tracking(k, tracks.ids.tolist(), tracks.names, found.boxes, found.scores.tolist(), calibration)
    scores = score_tracks([(labels, parse_tracking(text, calibration))]).classes
    assert sum(one.clear.switches for one in scores.values()) == 0
    assert scores["Car"].clear.mota > 0.85 and scores["Pedestrian"].clear.mota > 0.8
    assert scores["Cyclist"].hota.ass_a > 0.55
