"""What a file does not say and a reader must decide: how many columns, which is the intensity, what a header means."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.formats.binary import repeated_kinds
from beambox.data.read_points import points_from_array, read_frame, read_points

RNG = np.random.default_rng(7)
N = 34_720
SWEEP = np.column_stack(
    (
        RNG.uniform(-40, 40, (N, 2)),
        RNG.uniform(-2, 2, N),
        RNG.integers(0, 255, N),
        np.arange(N) % 32,
        RNG.random(N) / 10,
    )
).astype("<f4")


@pytest.mark.parametrize(
    ("columns", "fields"), [(3, "x,y,z"), (5, "x,y,z,intensity,ring"), (6, "x,y,z,intensity,ring,time")]
)
def test_a_bin_file_of_other_columns_is_refused_with_the_option_that_reads_it(
    tmp_path: Path, columns: int, fields: str
) -> None:
    """nuScenes' *.pcd.bin (5 columns, their number a multiple of 4) was read as 4: 125 % of the points, all mixed."""
    path = tmp_path / "n015__LIDAR_TOP__1531883530949817.pcd.bin"
    SWEEP[:, :columns].tofile(path)
    with pytest.raises(BeamboxError, match=f"looks like points of {columns} float32 .*--fields {fields} ") as caught:
        read_frame(path)
    assert "\n" not in str(caught.value)
    assert len(read_frame(path, fields=fields)) == N


def test_eight_columns_are_not_two_points(tmp_path: Path) -> None:
    np.column_stack((SWEEP, SWEEP[:, 4], np.zeros(N))).astype("<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(BeamboxError, match="points of 8 float32 numbers"):
        read_frame(tmp_path / "a.bin")


@pytest.mark.parametrize("change", ["plain", "none", "bytes", "front", "noise"])
def test_four_columns_stay_four(tmp_path: Path, change: str) -> None:
    cloud = SWEEP[:, :4].copy()
    cloud[:, 3] /= 255
    if change == "none":
        cloud[:, 3] = 0
    elif change == "bytes":
        cloud[:, 3] *= 255
    elif change == "front":
        cloud[:, 0] = np.abs(cloud[:, 0])
    elif change == "noise":
        cloud = RNG.normal(size=cloud.shape).astype("<f4")
    cloud.tofile(tmp_path / "a.bin")
    assert len(read_frame(tmp_path / "a.bin")) == N and repeated_kinds(cloud.reshape(-1)) == 4


def records(**columns: tuple[str, list]) -> np.ndarray:
    structured = np.zeros(
        4, [("x", "f4"), ("y", "f4"), ("z", "f4"), *((name, kind) for name, (kind, _) in columns.items())]
    )
    for name, (_, values) in columns.items():
        structured[name] = values
    return structured


def test_of_two_brightnesses_the_one_asked_for_is_taken(tmp_path: Path) -> None:
    """Ouster's clouds have intensity (photons, thousands) and reflectivity (0..255)."""
    cloud = records(
        intensity=("f4", [100, 500, 900, 1724]), t=("u4", [0] * 4), reflectivity=("u2", [10, 100, 200, 255])
    )
    np.save(tmp_path / "o.npy", cloud)
    plain = read_frame(tmp_path / "o.npy")
    torch.testing.assert_close(plain.points[:, 3], torch.tensor([100, 500, 900, 1724]) / 65535)
    assert (
        plain.notes[0] == "intensity is the column intensity; reflectivity is there too (--fields x,y,z,reflectivity)"
    )
    asked = read_frame(tmp_path / "o.npy", fields="x,y,z,reflectivity")
    torch.testing.assert_close(
        asked.points, torch.cat((torch.zeros(4, 3), torch.tensor([[10.0, 100, 200, 255]]).T / 255), 1)
    )
    both = read_frame(tmp_path / "o.npy", fields="x,y,z,intensity,reflectivity")
    assert both.points[:, 4].tolist() == [10, 100, 200, 255] and float(both.points[0, 3]) == pytest.approx(100 / 65535)


@pytest.mark.parametrize(
    "name",
    ["Intensity", "INTENSITY", "reflectivity", "Reflectance", "remissions", "scalar_Intensity", "amplitude",
     "Scalar field Intensity", "signal", "i", "refl", "scalar_Reflectance", "Intens", "intensities"],
)  # fmt: skip
def test_names_that_tools_give_the_intensity(tmp_path: Path, name: str) -> None:
    np.save(tmp_path / "a.npy", records(**{name: ("u1", [0, 51, 102, 255])}))
    torch.testing.assert_close(read_points(tmp_path / "a.npy")[:, 3], torch.tensor([0, 0.2, 0.4, 1.0]))


def test_red_is_no_reflectance(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", records(r=("u1", [9] * 4), g=("u1", [9] * 4), b=("u1", [9] * 4)))
    frame = read_frame(tmp_path / "a.npy")
    assert float(frame.points[:, 3].max()) == 0 and frame.notes == ("no intensity in the file: filled with 0",)


def test_a_point_of_unknown_intensity_is_still_a_point() -> None:
    cloud = np.ones((60, 4), dtype=np.float32)
    cloud[:, 3] = np.nan
    points, notes = points_from_array(cloud)
    assert len(points) == 60 and notes == ("60 of 60 values of intensity are NaN or infinite: set to 0",)


def test_records_of_odd_types(tmp_path: Path) -> None:
    kinds = [("xyz", "f4", 3), ("stamp", "M8[ns]"), ("phase", "c8"), ("more", [("intensity", "u1"), ("tag", "S3")])]
    cloud = np.zeros(5, kinds)
    cloud["xyz"], cloud["more"]["intensity"] = np.arange(15).reshape(5, 3), 51
    np.save(tmp_path / "a.npy", cloud)
    frame = read_frame(tmp_path / "a.npy")
    np.testing.assert_allclose(
        frame.points.numpy(), np.column_stack((np.arange(15).reshape(5, 3), [0.2] * 5)), rtol=1e-6
    )
    assert frame.notes[0].startswith("left out what is not one real number per point: stamp (datetime64[ns]), phase (")
    for kind in ("M8[s]", "c8", "m8[s]"):
        np.save(tmp_path / "b.npy", np.zeros((3, 4), kind))
        with pytest.raises(BeamboxError, match="must hold real numbers"):
            read_frame(tmp_path / "b.npy")


@pytest.mark.parametrize("name", ["xyz", "points", "positions", "anything"])
def test_archives_with_positions_and_brightness_apart(tmp_path: Path, name: str) -> None:
    np.savez(
        tmp_path / "a.npz",
        **{name: np.ones((4, 3)), "intensity": np.array([0, 51, 102, 255], "u1"), "ring": np.arange(4)},
    )
    frame = read_frame(tmp_path / "a.npz")
    torch.testing.assert_close(frame.points[:, 3], torch.tensor([0, 0.2, 0.4, 1.0]))
    assert frame.notes == ("intensity divided by 255",)
    assert read_points(tmp_path / "a.npz", fields="x,y,z,intensity,ring")[:, 4].tolist() == [0, 1, 2, 3]


BODY = "1 2 3 0.5\n4 5 6 0.25\n"
EXPECTED = [[1, 2, 3, 0.5], [4, 5, 6, 0.25]]
SIZES = "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
PCD = {
    "version .5": "# .PCD v.5\nVERSION .5\nCOLUMNS x y z intensity\nPOINTS 2\nDATA ascii\n",
    "no version": SIZES + "COUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n",
    "no count": "VERSION .7\n" + SIZES + "WIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n",
    "no points": "VERSION 0.7\n" + SIZES + "COUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nDATA ascii\n",
    "no width": "VERSION 0.7\n" + SIZES + "POINTS 2\nDATA ascii\n",
    "many comments": "#a\n#b\n" * 8 + "VERSION 0.7\n" + SIZES + "POINTS 2\nDATA ascii\n",
    "lower case, tabs": "version 0.7\nfields\tx y\tz intensity\nsize 4 4 4 4\ntype f f f f\npoints 2\ndata ascii\n",
    "viewpoint last": SIZES + "POINTS 2\nVIEWPOINT 0 0 0 1 0 0 0\nDATA ascii\n",
    "odd names": SIZES.replace("intensity", "Scalar_field_Range(m)") + "POINTS 2\nDATA ascii\n",
}


@pytest.mark.parametrize("name", PCD)
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_pcd_headers_as_tools_write_them(tmp_path: Path, name: str, line_end: str) -> None:
    pytest.importorskip("pypcd4")
    head = PCD[name]
    (tmp_path / "a.pcd").write_bytes((head + BODY).replace("\n", line_end).encode())
    expected = torch.tensor(EXPECTED)
    expected[:, 3] *= "odd" not in name  # that name is no intensity's
    torch.testing.assert_close(read_points(tmp_path / "a.pcd"), expected)


@pytest.mark.parametrize(
    "body", ["1\t2  3 0.5\n\n4 5 6 0.25", "1,2,3,0.5\n4,5,6,0.25\n", " 1 2 3 0.5 \n4 5 6 0.25\n9 9 9 9\n"]
)
def test_pcd_text_however_it_is_parted(tmp_path: Path, body: str) -> None:
    pytest.importorskip("pypcd4")
    (tmp_path / "a.pcd").write_text(PCD["no version"] + body, encoding="utf-8")
    torch.testing.assert_close(read_points(tmp_path / "a.pcd"), torch.tensor(EXPECTED))


def test_pcd_counts_that_disagree_follow_the_data(tmp_path: Path) -> None:
    pytest.importorskip("pypcd4")
    head = PCD["no version"].replace("POINTS 2", "POINTS 3")
    (tmp_path / "a.pcd").write_text(head + BODY, encoding="utf-8")
    frame = read_frame(tmp_path / "a.pcd")
    assert len(frame) == 2 and "POINTS 3 and WIDTH x HEIGHT 2 disagree: read 2" in frame.notes[0]
    (tmp_path / "a.pcd").write_text(head + BODY * 4, encoding="utf-8")
    with pytest.raises(BeamboxError, match="POINTS says 3, WIDTH x HEIGHT 2, and the data hold 8 points"):
        read_frame(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("COUNT 1 1 1 1", "COUNT 1 1 1 1000000000000", "COUNT promises 1000000000003"),
        ("COUNT 1 1 1 1", "COUNT 1 1 1", "expected 4 whole numbers"),
        ("SIZE 4 4 4 4", "SIZE 4 4 4 1000000000", "'intensity' has TYPE 'F' of 1000000000 bytes"),
        ("SIZE 4 4 4 4", "SIZE 4 4 4 -4", "line SIZE"),
        ("TYPE F F F F", "TYPE F F F Q", "TYPE 'Q'"),
        ("WIDTH 2\nHEIGHT 1\nPOINTS 2", "WIDTH 1000000000000\nHEIGHT 1\nPOINTS 1000000000000", "is cut short"),
        ("POINTS 2", "POINTS " + "9" * 5000, "line POINTS"),
        ("DATA ascii", "DATA binary_scaled", 'got "binary_scaled"'),
        ("FIELDS x y z intensity", "FIELDS", "must name 1 to 256 fields"),
    ],
)
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_headers_that_lie_are_refused_at_once(
    tmp_path: Path, old: str, new: str, message: str, encoding: str
) -> None:
    pytest.importorskip("pypcd4")
    head = PCD["no version"].replace(old, new).replace("DATA ascii", f"DATA {encoding}")
    (tmp_path / "a.pcd").write_bytes(head.encode() + BODY.encode())
    with pytest.raises(BeamboxError) as caught:
        read_frame(tmp_path / "a.pcd")
    assert len(str(caught.value)) < 400
    if encoding == "ascii":
        assert message in str(caught.value)


def test_pcd_compression_cannot_promise_more_than_it_can_hold(tmp_path: Path) -> None:
    pytest.importorskip("pypcd4")
    head = PCD["no version"].replace("2\nHEIGHT", "250000000\nHEIGHT").replace("POINTS 2", "POINTS 250000000")
    body = struct.pack("<II", 10, 4_000_000_000) + bytes(10)
    (tmp_path / "a.pcd").write_bytes(head.replace("ascii", "binary_compressed").encode() + body)
    with pytest.raises(BeamboxError, match="10 bytes cannot become 250000000 points"):
        read_frame(tmp_path / "a.pcd")


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    "property float intensity\nend_header\n"
)


@pytest.mark.parametrize(
    "head",
    [
        PLY,
        PLY.replace("\n", "\r\n"),
        PLY.replace("element", "comment Größe\nobj_info num_cols 7\nelement"),
        PLY.replace("vertex", "Vertices"),
        PLY.replace("float", "float32").replace("intensity", "scalar_Intensity"),
        PLY.replace("float intensity", "double Scalar field Intensity"),
        PLY.replace("end_header", "element face 0\nproperty list uchar int vertex_indices\nend_header"),
    ],
)
def test_ply_headers_as_tools_write_them(tmp_path: Path, head: str) -> None:
    pytest.importorskip("plyfile")
    (tmp_path / "a.ply").write_bytes(head.encode("latin-1") + BODY.encode())
    torch.testing.assert_close(read_points(tmp_path / "a.ply"), torch.tensor(EXPECTED))


@pytest.mark.parametrize(
    ("head", "message"),
    [
        (PLY.replace("element vertex 2", "element foo 1000000000000\nelement vertex 2"), "without any property"),
        (PLY.replace("vertex 2", "vertex 1000000000000"), "promises at least 4000000000000 bytes"),
        (PLY.replace("vertex 2", "vertex " + "9" * 5000), "it promises 9999"),
        (PLY.replace("vertex 2", "vertex -2"), "its header holds the line"),
        (PLY.replace("ascii", "binary"), "format must be"),
        (PLY.replace("float x", "complex x"), "its header holds the property"),
        (PLY.replace("ply", "plx", 1), "no header of the form"),
    ],
)
def test_ply_headers_that_lie_are_refused_at_once(tmp_path: Path, head: str, message: str) -> None:
    pytest.importorskip("plyfile")
    (tmp_path / "a.ply").write_bytes(head.encode() + BODY.encode())
    with pytest.raises(BeamboxError, match=message):
        read_frame(tmp_path / "a.ply")


def test_archives_that_grow_out_of_proportion_are_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "bomb.npz", points=np.zeros((30_000_000, 4), "f4"))
    assert (tmp_path / "bomb.npz").stat().st_size < 1_000_000
    with pytest.raises(BeamboxError, match="claims to grow to 480 MB"):
        read_frame(tmp_path / "bomb.npz")


@pytest.mark.parametrize("shape", [(10**12, 4), (2**40,), (2**62, 2**62)])
def test_arrays_that_promise_more_than_they_hold_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with (tmp_path / "a.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    with pytest.raises(BeamboxError, match="more than it holds"):
        read_frame(tmp_path / "a.npy")


def write_laz(path: Path, point_format: int, points: int = 5000) -> bytes:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = RNG.uniform(-50, 50, (3, points))
    las.intensity = RNG.integers(0, 65535, points)
    las.write(str(path))
    return path.read_bytes()


@pytest.mark.parametrize("point_format", [0, 3, 6, 7, 8])
def test_laz_of_each_kind_is_read(tmp_path: Path, point_format: int) -> None:
    write_laz(tmp_path / "a.laz", point_format)
    assert len(read_frame(tmp_path / "a.laz")) == 5000


@pytest.mark.parametrize("layer", range(9))
@pytest.mark.parametrize("value", [0xFFFFFFFF, 0x7FFFFFFF, 0])
def test_laz_layers_that_lie_are_refused_before_the_library_sees_them(tmp_path: Path, layer: int, value: int) -> None:
    content = bytearray(write_laz(tmp_path / "a.laz", 6))
    (start,) = struct.unpack_from("<I", content, 96)
    place = start + 8 + 30 + 4 + 4 * layer  # offset of the table, the first point, the number of points, the layers
    if struct.unpack_from("<I", content, place)[0] == value:
        return
    struct.pack_into("<I", content, place, value)
    (tmp_path / "b.laz").write_bytes(content)
    with pytest.raises(BeamboxError, match="its compressed part does not fit its size"):
        read_frame(tmp_path / "b.laz")


def test_las_records_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x = las.y = las.z = np.zeros(10)
    las.write(str(tmp_path / "a.las"))
    content = bytearray((tmp_path / "a.las").read_bytes())
    struct.pack_into("<QI", content, 235, len(content), 2**28)
    (tmp_path / "a.las").write_bytes(content)
    with pytest.raises(BeamboxError, match="promises 268435456 extended records"):
        read_frame(tmp_path / "a.las")
    struct.pack_into("<QI", content, 235, len(content), 1)
    (tmp_path / "a.las").write_bytes(content + bytes(20) + struct.pack("<Q", 2**60) + bytes(32))
    with pytest.raises(BeamboxError, match="an extended record does not fit"):
        read_frame(tmp_path / "a.las")
