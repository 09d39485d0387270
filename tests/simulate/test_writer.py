from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.kitti import KittiSource
from beambox.simulate import Sensor, simulate_frame, write_dataset, writer

QUICK = Sensor("quick", tuple(-0.8 * k for k in range(20)), 0.8, 1.73)


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def test_written_frames_are_read_back(tmp_path) -> None:
    write_dataset(tmp_path / "d", 4, QUICK, seed=3, val_share=0.4)
    names = [p.stem for p in sorted((tmp_path / "d/training/velodyne").iterdir())]
    assert names == ["000000", "000001", "000002", "000003"]
    train, val = ((tmp_path / f"d/ImageSets/{s}.txt").read_text().split() for s in ("train", "val"))
    assert sorted(train + val) == names
    assert train and val
    source = KittiSource(tmp_path / "d", "all")
    for k, name in enumerate(source.ids):
        frame, want = source[k], simulate_frame(3, int(name), sensor=QUICK)
        assert torch.equal(frame.points, want.points)
        assert frame.labels.names == want.labels.names
        assert torch.allclose(frame.labels.boxes, want.labels.boxes, atol=0.02)
        assert torch.equal(frame.labels.attributes.occlusion, want.labels.attributes.occlusion)
        assert torch.allclose(frame.labels.attributes.image.double(), want.labels.attributes.image, atol=0.01)


def test_workers_change_nothing(tmp_path) -> None:
    write_dataset(tmp_path / "one", 3, QUICK, seed=5)
    write_dataset(tmp_path / "two", 3, QUICK, seed=5, workers=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_interrupted_data_set_is_continued(tmp_path, monkeypatch) -> None:
    write_dataset(tmp_path / "whole", 4, QUICK, seed=1)
    real = writer.simulate_frame

    def stops(seed: int, index: int, **options):
        if index == 2:
            raise KeyboardInterrupt
        return real(seed, index, **options)

    monkeypatch.setattr(writer, "simulate_frame", stops)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path / "part", 4, QUICK, seed=1)
    lists = [(tmp_path / f"part/ImageSets/{s}.txt").read_text().split() for s in ("train", "val")]
    assert sorted(lists[0] + lists[1]) == ["000000", "000001"]  # what is whole can be used
    monkeypatch.setattr(writer, "simulate_frame", real)
    seen = []
    write_dataset(tmp_path / "part", 4, QUICK, seed=1, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(3, 4), (4, 4)]
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")


def test_another_simulation_and_other_data_are_refused(tmp_path) -> None:
    write_dataset(tmp_path / "d", 1, QUICK, seed=1)
    assert json.loads((tmp_path / "d/simulation.json").read_text())["seed"] == 1
    with pytest.raises(BeamboxError, match="was simulated with seed 1, now 2 is asked for"):
        write_dataset(tmp_path / "d", 2, QUICK, seed=2)
    (tmp_path / "other/training").mkdir(parents=True)
    with pytest.raises(BeamboxError, match=r"holds other data \(no simulation.json\); give another folder"):
        write_dataset(tmp_path / "other", 1, QUICK)


def test_bad_arguments_write_nothing(tmp_path) -> None:
    for options, message in (
        ({"frames": 0}, "must be at least 1, got 0 and 1"),
        ({"frames": 1, "workers": 0}, "must be at least 1, got 1 and 0"),
        ({"frames": 1, "val_share": 1.5}, "`val_share` must be at least 0 and less than 1"),
        ({"frames": 1, "view": "side"}, "`view` must be camera or full, got 'side'"),
        ({"frames": 1, "sensor": "hdl99"}, "`sensor` must be a preset or a .yaml file, got 'hdl99'"),
    ):
        with pytest.raises(BeamboxError, match=message):
            write_dataset(tmp_path / "d", **options)
    with pytest.raises(MissingFileError, match="is not there"):
        write_dataset(tmp_path / "d", 1, layout=f"kitti:{tmp_path}/labels.tar.gz")
    assert not (tmp_path / "d").exists()


def test_command_writes_a_data_set(tmp_path) -> None:
    from beambox.cli.simulate import command

    yaml = tmp_path / "quick.yaml"
    yaml.write_text("elevations: [-2, -4, -6]\nazimuth_step: 1.0\nheight: 1.7\n")
    command(tmp_path / "d", frames=2, sensor=str(yaml), view="full", seed=4)
    assert len(KittiSource(tmp_path / "d", "all")) == 2


@pytest.mark.parametrize(
    ("share", "frames", "expected"), [(0.3, 10, 3), (0.1, 25, 2), (0.5, 3, 2), (0.0, 4, 0), (0.2, 1, 0)]
)
def test_the_share_for_validation_is_exact(share: float, frames: int, expected: int, tmp_path: Path) -> None:
    from beambox.simulate.writer import KittiFiles

    files = KittiFiles(str(tmp_path), 0, {}, share)
    (tmp_path / "training" / "label_2").mkdir(parents=True)
    for number in range(frames):
        (tmp_path / "training" / "label_2" / f"{number:06d}.txt").write_text("")
    files.write_splits()
    val, train = ((tmp_path / "ImageSets" / f"{name}.txt").read_text().split() for name in ("val", "train"))
    assert len(val) == expected
    assert sorted([*val, *train]) == [f"{number:06d}" for number in range(frames)]
