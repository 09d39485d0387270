from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.once import ONCE_CLASSES, OnceSource
from beambox.data.open_dataset import open_dataset
from beambox.geometry.axes import Axes, turn_boxes
from beambox.ops.points_in_boxes import points_in_boxes
from beambox.simulate import Sensor, simulate_frame, write_dataset
from beambox.simulate.object_mix import ONCE_MIX
from beambox.simulate.once_files import in_once_axes
from beambox.structures import Labels

QUICK = Sensor("quick", tuple(1.0 - 1.1 * k for k in range(16)), 1.0, 1.8)


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    return write_dataset(
        tmp_path_factory.mktemp("once") / "d", 5, QUICK, seed=3, val_share=0.4, files="once", sequence_length=2
    )


def test_layout_is_once_s(written) -> None:
    assert sorted(p.name for p in (written / "data").iterdir()) == ["000000", "000001", "000002"]
    assert (written / "ImageSets/train.txt").read_text().split() == ["000000", "000002"]
    assert (written / "ImageSets/val.txt").read_text().split() == ["000001"]
    content = json.loads((written / "data/000001/000001.json").read_text())
    assert sorted(content) == ["calib", "frames", "meta_info"]
    assert [entry["frame_id"] for entry in content["frames"]] == ["000002", "000003"]
    for entry in content["frames"]:
        sweep = written / f"data/000001/lidar_roof/{entry['frame_id']}.bin"
        assert sweep.stat().st_size % 16 == 0
        assert len(entry["pose"]) == 7
        annotations = entry["annos"]
        assert len(annotations["names"]) == len(annotations["boxes_3d"]) > 0
        assert set(annotations["names"]) <= set(ONCE_CLASSES)
        assert annotations["boxes_2d"].keys() == content["calib"].keys()
    assert sorted(content["calib"]["cam01"]) == ["cam_intrinsic", "cam_to_velo", "distortion"]


def test_virtual_cameras_look_where_their_names_say(written) -> None:
    calib = json.loads((written / "data/000000/000000.json").read_text())["calib"]
    looks = {name: [round(row[2], 3) for row in one["cam_to_velo"][:3]] for name, one in calib.items()}
    assert looks["cam01"] == [0.0, -1.0, 0.0]  # ahead is -y in ONCE's axes
    assert looks["cam03"] == [0.0, 1.0, 0.0]
    assert looks["cam06"] == [0.707, -0.707, 0.0]  # half left
    for one in calib.values():
        assert torch.det(torch.tensor(one["cam_to_velo"])[:3, :3]) == pytest.approx(1.0, abs=1e-5)


def test_written_frames_are_read_back(written) -> None:
    source = OnceSource(written, "all")
    assert list(source.ids) == [f"{i:06d}" for i in range(5)]
    for frame in source:
        want = in_once_axes(simulate_frame(3, int(frame.id), sensor=QUICK, view="full", object_mix=ONCE_MIX))
        assert torch.equal(frame.points, want.points)
        assert frame.labels.names == want.labels.names
        assert torch.equal(frame.labels.boxes, want.labels.boxes)
    assert isinstance(open_dataset(written, "val"), OnceSource)


def test_axes_are_once_s_and_boxes_hold_the_same_points() -> None:
    frame = simulate_frame(1, 0, sensor=QUICK, view="full", object_mix=ONCE_MIX)
    turned = in_once_axes(frame)
    assert torch.allclose(turned.points[:, 0], frame.points[:, 1])  # x to the left
    assert torch.allclose(turned.points[:, 1], -frame.points[:, 0])  # y backward
    assert torch.equal(turned.points[:, 2:], frame.points[:, 2:])
    assert turned.calibration is None
    assert turned.labels.attributes is None
    before = points_in_boxes(frame.points[:, :3], frame.labels.boxes)
    after = points_in_boxes(turned.points[:, :3], turned.labels.boxes)
    assert (before != after).sum() <= 2  # rounding at faces
    assert (before >= 0).sum() > 50
    back = turn_boxes(turned.labels.boxes, Axes("left", "backward").matrix)
    assert torch.allclose(back, frame.labels.boxes, atol=1e-5)


def test_workers_and_growth_change_nothing(written, tmp_path) -> None:
    again = {"seed": 3, "val_share": 0.4, "files": "once", "sequence_length": 2}
    write_dataset(tmp_path / "grown", 3, QUICK, **again)  # sequence 1 holds one frame, later two
    seen = []
    write_dataset(
        tmp_path / "grown", 5, QUICK, workers=2, progress=lambda done, total: seen.append((done, total)), **again
    )
    assert sorted(seen) in ([(3, 5), (5, 5)], [(4, 5), (5, 5)])  # whichever sequence is first
    assert contents(tmp_path / "grown") == contents(written)


def test_object_mix_has_once_s_five_classes_and_maps_vans() -> None:
    names = set()
    for index in range(6):
        names |= set(simulate_frame(2, index, sensor=QUICK, view="full", object_mix=ONCE_MIX).labels.names)
    assert names == set(ONCE_CLASSES)
    boxes = torch.ones(4, 7)
    labels = ONCE_MIX.rename(Labels(boxes, ("Van", "Misc", "Tram", "Person_sitting")))
    assert labels.names == ("Car", "Bus", "Pedestrian")
    assert len(ONCE_MIX.rename(Labels.empty())) == 0


def test_other_layouts_and_views_are_refused(written, tmp_path) -> None:
    with pytest.raises(BeamboxError, match=r"`files` must be kitti or once, got 'onze' \(did you mean \"once\""):
        write_dataset(tmp_path / "d", 1, QUICK, files="onze")
    with pytest.raises(BeamboxError, match="ONCE labels the whole turn"):
        write_dataset(tmp_path / "d", 1, QUICK, view="camera", files="once")
    assert not (tmp_path / "d").exists()
    with pytest.raises(BeamboxError, match="was simulated with files 'once', now 'kitti' is asked for"):
        write_dataset(written, 5, QUICK, seed=3, val_share=0.4)
    with pytest.raises(BeamboxError, match="was simulated with sequence_length 2, now 3 is asked for"):
        write_dataset(written, 5, QUICK, seed=3, val_share=0.4, files="once", sequence_length=3)
    with pytest.raises(BeamboxError, match="was simulated with sensor 'quick', now 'pandar40' is asked for"):
        write_dataset(written, 5, seed=3, val_share=0.4, files="once", sequence_length=2)
    with pytest.raises(BeamboxError, match=r"was simulated with sensor.height 1.8, now 2.0 is asked for"):
        write_dataset(written, 5, replace(QUICK, height=2.0), seed=3, val_share=0.4, files="once", sequence_length=2)
    (tmp_path / "real/data").mkdir(parents=True)
    with pytest.raises(BeamboxError, match="holds other data"):
        write_dataset(tmp_path / "real", 1, QUICK, files="once")


def test_broken_sequence_is_named(tmp_path) -> None:
    options = {"seed": 1, "files": "once", "sequence_length": 1}
    write_dataset(tmp_path / "d", 1, QUICK, **options)
    (tmp_path / "d/data/000000/000000.json").write_text('{"frames"')
    with pytest.raises(BeamboxError, match=r"000000.json is no sequence of ONCE .*; delete it or give another folder"):
        write_dataset(tmp_path / "d", 1, QUICK, **options)
