"""Sweeps of every format, good and bad."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.formats.columns import library
from beambox.data.read_points import SUFFIXES, points_from_array, read_frame, read_points, read_shifted
from oracles.paths import data_dir

RNG = np.random.default_rng(5)
CLOUD = (RNG.random((40, 4)) * [60, 20, 3, 1] - [0, 10, 2, 0]).astype(np.float32)


def write_pcd(path: Path, cloud: np.ndarray, encoding: str) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    pypcd4.PointCloud.from_xyzi_points(cloud).save(path, encoding=pypcd4.Encoding(encoding))


def write_ply(path: Path, cloud: np.ndarray, text: bool, name: str = "intensity") -> None:
    plyfile = pytest.importorskip("plyfile")
    records = np.empty(len(cloud), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), (name, "f4")])
    for k, field in enumerate(records.dtype.names or ()):
        records[field] = cloud[:, k]
    plyfile.PlyData([plyfile.PlyElement.describe(records, "vertex")], text=text).write(str(path))


def write_las(path: Path, cloud: np.ndarray, top: int = 65535) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = [0.001] * 3
    header.offsets = cloud[:, :3].astype(np.int64).min(axis=0) if len(cloud) else [0] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud[:, 0], cloud[:, 1], cloud[:, 2]
    las.intensity = np.round(cloud[:, 3] * top).astype(np.uint16)
    las.write(str(path))


def write(path: Path, cloud: np.ndarray = CLOUD, how: str = "") -> Path:
    if path.suffix == ".bin":
        cloud.astype("<f4").tofile(path)
    elif path.suffix == ".npy":
        np.save(path, cloud)
    elif path.suffix == ".npz":
        np.savez(path, points=cloud, other=np.arange(3))
    elif path.suffix == ".pcd":
        write_pcd(path, cloud, how or "binary")
    elif path.suffix == ".ply":
        write_ply(path, cloud, how == "text")
    else:
        write_las(path, cloud)
    return path


@pytest.mark.parametrize(
    ("name", "how"),
    [(f"a{suffix}", "") for suffix in SUFFIXES]
    + [("a.pcd", "ascii"), ("a.pcd", "binary_compressed"), ("a.ply", "text"), ("a.BIN", "")],
)
def test_every_format_gives_the_same_points(tmp_path: Path, name: str, how: str) -> None:
    path = write(tmp_path / name.lower(), how=how).rename(tmp_path / name)
    frame = read_frame(path)
    assert frame.id == "a" and frame.points.dtype == torch.float32
    tolerance = 6e-4 if path.suffix in (".las", ".laz") else 1e-5
    np.testing.assert_allclose(frame.points.numpy(), CLOUD, atol=tolerance)
    assert torch.equal(read_points(path), frame.points)
    assert frame.notes == (("intensity divided by 65535",) if path.suffix in (".las", ".laz") else ())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_empty_cloud_is_no_error(tmp_path: Path, suffix: str) -> None:
    frame = read_frame(write(tmp_path / f"none{suffix}", CLOUD[:0]))
    assert frame.points.shape == (0, 4)


def test_named_columns_of_a_bin_file(tmp_path: Path) -> None:
    five = np.concatenate((CLOUD, np.arange(40, dtype=np.float32)[:, None]), axis=1)
    path = write(tmp_path / "five.bin", five)
    kept = read_frame(path, fields="x,y,z,intensity,ring")
    assert torch.equal(kept.points, torch.from_numpy(five))
    assert torch.equal(read_frame(path, fields=["x", "y", "z", "intensity", "_"]).points, kept.points[:, :4])
    swapped = read_points(path, fields="y, x, z, _, intensity", intensity_scale=1 / 39)
    assert torch.equal(swapped[:, :2], kept.points[:, [1, 0]])
    torch.testing.assert_close(swapped[:, 3], torch.arange(40) / 39.0)
    short = write(tmp_path / "short.bin", five[:37])  # 185 numbers: not a whole number of four
    with pytest.raises(BeamboxError, match='for 5 columns give `fields`, such as "x,y,z,intensity,ring"'):
        read_frame(short)
    with pytest.raises(BeamboxError, match="`fields` must name x, y and z, each name once"):
        read_frame(path, fields="x,y,intensity")


def test_columns_of_named_formats_can_be_chosen(tmp_path: Path) -> None:
    records = np.zeros(3, dtype=[("X", "f8"), ("Y", "f8"), ("Z", "f8"), ("reflectivity", "u1"), ("ring", "u2")])
    records["reflectivity"], records["ring"] = [0, 51, 255], [7, 8, 9]
    np.save(tmp_path / "a.npy", records)
    frame = read_frame(tmp_path / "a.npy", fields="x,y,z,intensity,ring")
    assert frame.points[:, 4].tolist() == [7, 8, 9]
    torch.testing.assert_close(frame.points[:, 3], torch.tensor([0, 0.2, 1]))
    assert frame.notes == ("intensity divided by 255",)
    with pytest.raises(BeamboxError, match=r'a.npy has no column "rings" \(did you mean "ring"\?\)'):
        read_frame(tmp_path / "a.npy", fields="x,y,z,rings")


def test_columns_without_a_name_are_left_out_and_said(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((2, 6)))
    frame = read_frame(tmp_path / "a.npy")
    assert frame.points.shape == (2, 4) and frame.notes == (
        "left out columns 5 to 6: name them by `fields` to keep them",
    )
    assert read_points(tmp_path / "a.npy", fields="x,y,z,intensity,ring,time").shape == (2, 6)
    with pytest.raises(BeamboxError, match="has 6 columns, but `fields` names 4"):
        read_frame(tmp_path / "a.npy", fields="x,y,z,intensity")


@pytest.mark.parametrize(
    ("values", "dtype", "expected", "notes"),
    [
        ([0, 0.5, 1], "f4", [0, 0.5, 1], ()),
        ([0, 51, 255], "f4", [0, 0.2, 1], ("intensity divided by 255",)),
        ([0, 1, 51], "f8", [0, 1 / 255, 0.2], ("intensity divided by 255",)),
        ([0, 6553.5, 65535], "f4", [0, 0.1, 1], ("intensity divided by 65535",)),
        ([0, 1e5, 1e6], "f4", [0, 0.1, 1], ("intensity divided by 1e+06",)),
        ([0, 1, 1], "u1", [0, 1 / 255, 1 / 255], ("intensity divided by 255",)),
        ([0, 51, 255], "u2", [0, 0.2, 1], ("intensity divided by 255",)),
        ([0, 256, 65535], "u2", [0, 256 / 65535, 1], ("intensity divided by 65535",)),
        ([-0.5, 0, 1], "f4", [0, 0, 1], ("clipped 1 of 3 intensities to [0, 1]",)),
    ],
)
def test_the_intensity_rule(tmp_path: Path, values: list, dtype: str, expected: list, notes: tuple) -> None:
    records = np.zeros(3, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", dtype)])
    records["intensity"] = values
    np.save(tmp_path / "a.npy", records)
    frame = read_frame(tmp_path / "a.npy")
    torch.testing.assert_close(frame.points[:, 3], torch.tensor(expected, dtype=torch.float32))
    assert frame.notes == notes


def test_a_few_stray_intensities_do_not_darken_the_sweep() -> None:
    cloud = np.zeros((5000, 4), dtype=np.float32)
    cloud[:, 3] = np.linspace(0, 1, 5000)
    cloud[17, 3] = 900
    points, notes = points_from_array(cloud)
    assert float(points[2500, 3]) == pytest.approx(cloud[2500, 3]) and float(points[17, 3]) == 1
    assert notes == ("clipped 1 of 5000 intensities to [0, 1]",)


def test_the_intensity_scale_can_be_given() -> None:
    cloud = np.full((2, 4), 50.0)
    points, notes = points_from_array(torch.from_numpy(cloud), intensity_scale=0.01)
    assert points[:, 3].tolist() == [0.5, 0.5] and notes == ("intensity multiplied by 0.01 as asked",)
    assert points_from_array(cloud, intensity_scale=1)[1] == ("2 of 2 intensities lie outside [0, 1]",)
    assert points_from_array(cloud, intensity_scale=1)[0][:, 3].tolist() == [50, 50]
    with pytest.raises(BeamboxError, match="`intensity_scale` must be a positive number, got -1"):
        points_from_array(cloud, intensity_scale=-1)


def test_missing_intensity_is_filled_and_said(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", CLOUD[:, :3])
    frame = read_frame(tmp_path / "a.npy")
    assert frame.notes == ("no intensity in the file: filled with 0",) and float(frame.points[:, 3].max()) == 0


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    cloud = CLOUD.copy()
    cloud[3, 2], cloud[5, 3], cloud[9, 0] = np.nan, np.nan, -np.inf
    frame = read_frame(write(tmp_path / "a.bin", cloud))
    assert len(frame) == 38 and frame.notes == (
        "1 of 40 values of intensity are NaN or infinite: set to 0",
        "dropped 2 of 40 points that are NaN or infinite",
    )


def test_map_coordinates_are_shifted_before_float32_rounds_them(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    write_las(path, CLOUD + np.array([4.5e5, 5.4e6, 0, 0]))
    frame, shift = read_shifted(path)
    assert "map coordinates: 450033 was taken from x" in frame.notes[-1]
    back = frame.points[:, :2].double().numpy() + shift - np.array([4.5e5, 5.4e6])
    np.testing.assert_allclose(back, CLOUD[:, :2], atol=6e-4)  # float32 alone would leave 0.5 m
    far = CLOUD + np.array([4.5e5, 5.4e6, 0, 0], dtype=np.float32)
    assert "shift them first (as float32 they are rounded to 0.5 m already)" in points_from_array(far)[1][-1]


def bad_files(folder: Path) -> list[tuple[Path, str]]:
    (folder / "text.bin").write_text("1.0 2.0 3.0 0.5\n" * 8)
    np.random.default_rng(0).normal(0, 20, (50, 4)).tofile(folder / "double.bin")
    (folder / "cut.bin").write_bytes(CLOUD.tobytes()[:-3])
    (folder / "folder.bin").mkdir()
    (folder / "folder.ply").mkdir()
    np.save(folder / "flat.npy", np.zeros(12))
    np.save(folder / "turned.npy", np.zeros((4, 1000)))
    np.save(folder / "text.npy", np.array([["a", "b", "c"]]))
    np.save(folder / "object.npy", np.array([[1, None, "c"]], dtype=object), allow_pickle=True)
    np.savez(folder / "two.npz", a=np.zeros((3, 4)), b=np.zeros((3, 4)))
    np.savez(folder / "names.npz", time=np.zeros(3), x=np.zeros(3))
    (folder / "not.npy").write_bytes(b"hello there")
    write(folder / "whole.pcd")
    (folder / "cut.pcd").write_bytes((folder / "whole.pcd").read_bytes()[:-32])
    (folder / "not.ply").write_bytes(b"ply\nformat wrong\n")
    (folder / "not.las").write_bytes(b"LASF" + bytes(50))
    (folder / "a.pkl").write_bytes(b"")
    return [
        (folder / "text.bin", "is a text file (it begins '1.0 2.0 3.0 0.5"),
        (folder / "double.bin", "it looks like float64: convert it with points.astype('float32').tofile(...)"),
        (folder / "cut.bin", "whole points of 4 float32 numbers (16 bytes), but has 637 bytes, 13 too many"),
        (folder / "folder.bin", "cannot be read: Is a directory"),
        (folder / "folder.ply", "must be a PLY file, but is a folder"),
        (folder / "flat.npy", "must hold an array of shape (N, 3 or more), got (12,)"),
        (folder / "turned.npy", "got an array of shape (4, 1000); is it transposed?"),
        (folder / "text.npy", "must hold real numbers, got an array of <U1"),
        (folder / "object.npy", "(ValueError: it holds pickled objects, which could run code)"),
        (
            folder / "two.npz",
            "must hold an array named `points`, or one two-dimensional array, or x, y and z; got a, b",
        ),
        (folder / "names.npz", "must hold an array named `points`"),
        (
            folder / "not.npy",
            "is not a readable NumPy file (.npy), or is damaged (ValueError: it does not begin like one)",
        ),
        (folder / "cut.pcd", "is cut short: its header promises 40 points, it holds 38"),
        (
            folder / "not.ply",
            "is not a readable PLY file, or is damaged (it has no header of the form ply ... end_header)",
        ),
        (folder / "not.las", "is not a readable LAS file, or is damaged ("),
        (folder / "a.pkl", 'has the ending ".pkl", which no reader knows (did you mean '),
        (folder / "none.npy", "is not there"),
    ]


def test_bad_files_are_named_with_a_reason(tmp_path: Path) -> None:
    for path, message in bad_files(tmp_path):
        with pytest.raises(BeamboxError) as caught:
            read_frame(path)
        assert str(caught.value).startswith(str(path)) and message in str(caught.value), path.name
    for suffix in SUFFIXES:
        with pytest.raises(MissingFileError, match="is not there"):
            read_frame(tmp_path / f"absent{suffix}")


def test_coordinates_that_are_missing_are_named(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", CLOUD, text=False)
    content = (tmp_path / "a.ply").read_bytes().replace(b"property float z", b"property float q")
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(BeamboxError, match="must have columns x, y and z; z not found among x, y, q, intensity"):
        read_frame(tmp_path / "a.ply")


def test_an_absent_library_comes_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypcd4", None)
    with pytest.raises(
        BeamboxError, match=r'needs the library pypcd4, which is not installed: python -m pip install "\.\[formats\]"'
    ):
        library("pypcd4", Path("a.pcd"))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(SUFFIXES), st.binary(max_size=400), st.randoms(use_true_random=False), st.integers(0, 3))
def test_no_bytes_make_a_reader_fail_otherwise(tmp_path: Path, suffix: str, noise: bytes, random, kind: int) -> None:
    """Random bytes, and good files with bytes changed, cut or added, give a frame or a BeamboxError: nothing else."""
    path = write(tmp_path / f"good{suffix}", CLOUD[:5], how="binary_compressed" if kind == 1 else "")
    content = bytearray(path.read_bytes())
    if kind == 0:
        content = bytearray(noise)
    elif kind == 1:
        del content[random.randrange(len(content)) :]
    else:
        for byte in noise[:8]:
            content[random.randrange(len(content) if kind == 2 else min(200, len(content)))] = byte
    path = tmp_path / f"fuzz{suffix}"
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            frame = read_frame(path)
        except BeamboxError as error:
            assert str(path) in str(error)
        else:
            assert bool(frame.points.isfinite().all()) and frame.points.shape[1] == 4


def test_real_sweeps_read() -> None:
    for path in (*data_dir("pandaset_002").rglob("*.bin"), *data_dir("kitti_drive_0052").glob("*.bin")):
        frame = read_frame(path)
        assert len(frame) > 90_000 and frame.notes == ()
        assert 0 <= float(frame.points[:, 3].min()) and float(frame.points[:, 3].max()) <= 1
