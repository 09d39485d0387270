"""Files, folders and patterns become sweeps with unique names."""

from __future__ import annotations

from pathlib import Path

import pytest

from beambox.checks import BeamboxError, MissingFileError
from beambox.infer.inputs import calibration_beside, find_sweeps, read_sweep
from oracles.tiny_detector import kitti_folder, street


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    for name in ("b.bin", "a.pcd", "c.npy", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    return tmp_path


def test_a_folder_gives_its_sweeps_in_order_and_nothing_else(scans: Path) -> None:
    assert [sweep.path.name for sweep in find_sweeps([scans])] == ["a.pcd", "b.bin", "c.npy"]


def test_patterns_files_and_folders_mix_without_repeats(scans: Path) -> None:
    found = find_sweeps([scans / "c.npy", f"{scans}/*.bin", scans])
    assert [sweep.path.name for sweep in found] == ["c.npy", "b.bin", "a.pcd"]


def test_a_data_set_in_kitti_layout_gives_its_sweeps(tmp_path: Path) -> None:
    kitti_folder(tmp_path)
    assert [sweep.name for sweep in find_sweeps([tmp_path])] == ["000000", "000001"]
    assert [sweep.name for sweep in find_sweeps([tmp_path / "training"])] == ["000000", "000001"]


def test_files_of_one_name_get_their_folders(tmp_path: Path) -> None:
    for folder in ("drive/one", "drive/two"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "0.bin").write_bytes(b"")
    assert [sweep.name for sweep in find_sweeps([f"{tmp_path}/drive/**/*.bin"])] == ["one/0", "two/0"]


def test_files_that_differ_in_their_ending_alone_are_refused(tmp_path: Path) -> None:
    for name in ("0.bin", "0.pcd"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(BeamboxError, match='both called "0"'):
        find_sweeps([tmp_path])


def test_what_is_not_there_is_said_with_what_is(scans: Path) -> None:
    with pytest.raises(MissingFileError, match=r"d\.bin is not there; .* holds a\.pcd, b\.bin, c\.npy"):
        find_sweeps([scans / "d.bin"])
    with pytest.raises(MissingFileError, match=r"no file fits the pattern .*\*\.las"):
        find_sweeps([f"{scans}/*.las"])
    (scans / "empty").mkdir()
    with pytest.raises(MissingFileError, match=r"holds no sweep; looked for \*\.bin"):
        find_sweeps([scans / "empty"])


def test_a_sweep_in_kitti_layout_brings_what_lies_beside_it(tmp_path: Path) -> None:
    velodyne = kitti_folder(tmp_path)
    first, second = (read_sweep(velodyne / f"{name}.bin", labels=True) for name in ("000000", "000001"))
    assert first.calibration is not None and first.labels is not None and first.labels.names == ("Car",)
    assert first.image_path is not None and first.image_size == (1200, 360)
    assert second.image_path is None and second.image_size == (1242, 375)
    assert read_sweep(velodyne / "000000.bin").labels is None


def test_a_sweep_elsewhere_is_points_alone(tmp_path: Path) -> None:
    street().tofile(tmp_path / "scan.bin")
    frame = read_sweep(tmp_path / "scan.bin", labels=True)
    assert (frame.id, frame.calibration, frame.labels) == ("scan", None, None)
    assert calibration_beside(tmp_path / "scan.bin") is None
