"""ONCE's layout: reading and writing are inverse, and every fault is one clear line."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.names import NameList
from beambox.data.once import ONCE_CLASSES, OnceSource, write_once_sequence, write_once_split
from beambox.data.source import FrameSource
from beambox.structures import Frame, Labels
from oracles.paths import ROOT


def frame(rng: np.random.Generator, name: str, boxes: int | None) -> Frame:
    points = torch.tensor(rng.normal(0, 20, (50, 4)), dtype=torch.float32)
    points[:, 3] = torch.tensor(rng.random(50))
    if boxes is None:
        return Frame(points, name)
    numbers = np.column_stack((rng.normal(0, 20, (boxes, 3)), rng.uniform(1, 5, (boxes, 3)), rng.uniform(-3, 3, boxes)))
    return Frame(points, name, Labels(torch.tensor(numbers), tuple(rng.choice(ONCE_CLASSES, boxes))))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    write_once_sequence(tmp_path, "000001", [frame(rng, "100", 3), frame(rng, "101", None), frame(rng, "102", 0)])
    write_once_sequence(tmp_path, "000002", [frame(rng, "200", 5)])
    write_once_split(tmp_path, "train", ["000001"])
    write_once_split(tmp_path, "val", ["000001", "000002"])
    return tmp_path


def same(a: Frame, b: Frame) -> None:
    assert a.id == b.id
    assert torch.equal(a.points, b.points)
    assert (a.labels is None) == (b.labels is None)
    if a.labels is not None and b.labels is not None:
        assert torch.equal(a.labels.boxes, b.labels.boxes)
        assert a.labels.names == b.labels.names


def test_once_reading_and_writing_are_inverse(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    first = OnceSource(root, "val", labeled=False)
    assert isinstance(first, FrameSource)
    assert list(first.ids) == ["100", "101", "102", "200"]
    again = tmp_path_factory.mktemp("again")
    write_once_sequence(again, "000001", (first[i] for i in range(3)))
    write_once_sequence(again, "000002", [first[3]])
    write_once_split(again, "val", ["000001", "000002"])
    second = OnceSource(again, "val", labeled=False)
    rng = np.random.default_rng(0)
    source_frames = [frame(rng, "100", 3), frame(rng, "101", None), frame(rng, "102", 0), frame(rng, "200", 5)]
    for i, wanted in enumerate(source_frames):
        same(first[i], wanted)
        same(second[i], first[i])
    for sequence in ("000001", "000002"):
        assert (again / "data" / sequence / f"{sequence}.json").read_text() == (
            root / "data" / sequence / f"{sequence}.json"
        ).read_text()


def test_once_keeps_labeled_frames_with_boxes(root: Path) -> None:
    assert list(OnceSource(root, "val").ids) == ["100", "200"]
    assert list(OnceSource(root, "val", keep_empty=True).ids) == ["100", "102", "200"]
    assert list(OnceSource(root, "all", labeled=False).ids) == ["100", "101", "102", "200"]
    source = OnceSource(root, "val", labeled=False)
    assert source.labels(1) is None and source[-1].id == "200"
    last = source.labels(-1)
    assert last is not None and len(last) == 5


def test_once_source_survives_pickling(root: Path) -> None:
    source = OnceSource(root, "val")
    same(pickle.loads(pickle.dumps(source))[1], source[1])


def test_once_maps_classes(root: Path) -> None:
    mapping = {"Car": "Vehicle", "Bus": "Vehicle", "Truck": "Vehicle", "Pedestrian": None, "Cyclist": None}
    for labels in (OnceSource(root, "val", mapping=mapping, keep_empty=True).labels(i) for i in range(3)):
        assert labels is not None and set(labels.names) <= {"Vehicle"}
    with pytest.raises(BeamboxError, match=r'000001.json, frames\[0\].annos.names\[\d\]: no mapping names the class "'):
        OnceSource(root, "val", mapping={"Tram": "Tram"})


def test_once_repeated_frame_names_are_told_apart(root: Path) -> None:
    write_once_sequence(root, "000002", [frame(np.random.default_rng(3), "100", 1)])
    source = OnceSource(root, "val")
    assert list(source.ids) == ["000001_100", "000002_100"]
    assert source[1].id == "000002_100" and len(source[1]) == 50


def test_once_intensity_follows_the_one_rule_unless_asked(root: Path) -> None:
    path = root / "data" / "000002" / "lidar_roof" / "200.bin"
    points = np.fromfile(path, dtype="<f4").reshape(-1, 4)
    points[:, 3] *= 200
    points[0, 0] = np.nan
    points.tofile(path)
    read = OnceSource(root, "val")[1]
    assert len(read) == 49 and read.points[:, 3].max() <= 1 and "intensity divided by 255" in read.notes
    raw = OnceSource(root, "val", intensity_scale=1)[1]
    assert raw.points[:, 3].max() > 1
    assert any("dropped 1 of 50 points" in note for note in read.notes)
    assert any("intensities lie outside [0, 1]" in note for note in raw.notes)
    assert OnceSource(root, "val", intensity_scale=1 / 255)[1].points[:, 3].max() <= 1


def edit(root: Path, change: str) -> None:
    path = root / "data" / "000001" / "000001.json"
    content = json.loads(path.read_text())
    first = content["frames"][0]
    if change == "no frames":
        content = {"frame": []}
    elif change == "no id":
        del content["frames"][1]["frame_id"]
    elif change == "no boxes":
        del first["annos"]["boxes_3d"]
    elif change == "short row":
        first["annos"]["boxes_3d"][0].pop()
    elif change == "one name less":
        first["annos"]["names"].pop()
    elif change == "negative size":
        first["annos"]["boxes_3d"][1][4] = -1
    path.write_text(json.dumps(content)[: -5 if change == "cut" else None])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("cut", r"000001\.json is not valid JSON"),
        ("no frames", r"000001\.json: expected a list under the key `frames`"),
        ("no id", r"000001\.json, frames\[1\]: the key `frame_id` is missing"),
        ("no boxes", r"000001\.json, frames\[0\]\.annos: expected a list under the key `boxes_3d`"),
        ("short row", r"frames\[0\]\.annos\.boxes_3d: expected rows of 7 numbers"),
        ("one name less", r"frames\[0\]\.annos: 2 names but 3 boxes_3d"),
        ("negative size", r"frames\[0\]\.annos\.boxes_3d: expected finite numbers and sizes of at least 0"),
    ],
)
def test_once_faults_name_file_and_key(root: Path, change: str, message: str) -> None:
    edit(root, change)
    with pytest.raises(BeamboxError, match=message) as caught:
        OnceSource(root, "train")
    assert "\n" not in str(caught.value)


def test_once_missing_things_are_named(root: Path, tmp_path: Path) -> None:
    (root / "data" / "000002" / "lidar_roof" / "200.bin").unlink()
    source = OnceSource(root, "val")
    with pytest.raises(MissingFileError, match=r"200\.bin is not there, though .*000002\.json lists the frame 200"):
        source[1]
    (root / "data" / "000002" / "000002.json").unlink()
    with pytest.raises(MissingFileError, match=r"000002\.json is not there"):
        OnceSource(root, "val")
    with pytest.raises(MissingFileError, match=r'no split "vall" \(did you mean "val"\?\)'):
        OnceSource(root, "vall")
    with pytest.raises(MissingFileError, match="must hold the folder data/"):
        OnceSource(tmp_path / "none")


def test_name_list_is_a_sequence() -> None:
    names = NameList(["a", "bürste", "c"])
    assert list(names) == ["a", "bürste", "c"] and names[-2] == "bürste" and list(names[1:]) == ["bürste", "c"]
    assert names.first_repeated() is None
    assert NameList.join([names, names]).first_repeated() == "a"
    assert list(NameList([])) == [] and list(NameList.join([])) == []


OPEN_ONCE = """
import resource, sys, time
import numpy, torch
from beambox.data.once import OnceSource
start = time.process_time()
source = OnceSource(sys.argv[1], "raw", labelled=False)
seconds = time.process_time() - start
print(len(source), source.ids[999_999], seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux only")
def test_once_index_of_a_million_frames_opens_fast_and_small(tmp_path: Path) -> None:
    entry = (
        '{"sequence_id": "%s", "frame_id": "%d", "pose": [0.0123456789, -0.0123456789, 0.7123456789, 0.7023456789, '
        "1234.56789012, -2345.67890123, 34.5678901234]}"
    )
    names = [f"{s:06d}" for s in range(500)]
    for s, name in enumerate(names):
        frames = ", ".join(entry % (name, 1616343528200 + s * 10**6 + i * 500) for i in range(2000))
        (tmp_path / "data" / name).mkdir(parents=True)
        (tmp_path / "data" / name / f"{name}.json").write_text(
            f'{{"meta_info": {{}}, "calib": {{}}, "frames": [{frames}]}}'
        )
    write_once_split(tmp_path, "raw", names)
    command = [sys.executable, "-c", OPEN_ONCE, str(tmp_path)]
    output = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}
    ).stdout.split()
    assert output[:2] == ["1000000", str(1616343528200 + 499 * 10**6 + 1999 * 500)]
    assert float(output[2]) < 10, f"{output[2]} s of one core"
    assert float(output[3]) < 1e9, f"{output[3]} bytes"
