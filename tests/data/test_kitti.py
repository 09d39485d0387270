"""KITTI's text files and folder layout."""

from __future__ import annotations

import contextlib
import struct
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.ground_plane import fit_ground_plane
from beambox.data.kitti import (
    KittiSource,
    format_calibration,
    format_labels,
    parse_calibration,
    parse_labels,
    parse_results,
    png_size,
    write_kitti_frame,
    write_split,
)
from beambox.data.kitti_text import parse_plane
from beambox.geometry import Calibration
from beambox.structures import Frame, Labels
from oracles.paths import data_dir

CALIB = Calibration(
    p2=torch.tensor([[700.0, 0, 600, 45], [0, 700, 180, 0.2], [0, 0, 1, 0.003]]),
    r0=torch.eye(3),
    velo_to_cam=torch.tensor([[0.0, -1, 0, 0.0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]]),
)
CAR = "Car 0.25 1 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57\n"
DONT_CARE = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10\n"


def frame(name: str = "000007", points: int = 50) -> Frame:
    generator = torch.Generator().manual_seed(1)
    cloud = torch.rand(points, 4, generator=generator) * torch.tensor([40.0, 20, 2, 1]) - torch.tensor([0.0, 10, 2, 0])
    return Frame(cloud, name, parse_labels(CAR + DONT_CARE, CALIB), CALIB)


def test_label_columns_mean_what_the_devkit_says() -> None:
    labels = parse_labels(CAR + DONT_CARE, CALIB)
    assert labels.names == ("Car",)
    # bottom centre (right 15.53 -> y, down 2.39, forward 58.49) seen from the LiDAR; yaw = -(ry + pi / 2)
    expected = [58.49 + 0.27, 16.53, -2.39 - 0.08 + 1.67 / 2, 3.69, 1.87, 1.67, -(1.57 + np.pi / 2)]
    np.testing.assert_allclose(labels.boxes[0].numpy(), expected, atol=1e-4)
    attributes = labels.attributes
    assert attributes is not None and attributes.camera is not None
    assert attributes.truncation.tolist() == [0.25] and attributes.occlusion.tolist() == [1]
    assert attributes.camera.tolist() == [[1.67, 1.87, 3.69, -16.53, 2.39, 58.49, 1.57]]
    np.testing.assert_allclose(labels.ignored_image.numpy(), [[503.89, 169.71, 590.61, 190.13]], atol=1e-4)


@pytest.mark.parametrize("every", [40, pytest.param(1, marks=pytest.mark.slow)])
def test_labels_and_calibrations_round_trip_to_the_printed_digit(every: int) -> None:
    with tarfile.open(data_dir() / "kitti_labels.tar.gz") as archive:
        texts = {
            member.name: stream.read().decode()
            for member in archive
            if Path(member.name).stem.isdigit() and int(Path(member.name).stem) % every == 0
            if (stream := archive.extractfile(member)) is not None
        }
    names = [name for name in texts if "label_2" in name]
    assert len(names) == -(-7481 // every)
    for name in names:
        calib_text = texts[name.replace("label_2", "calib")]
        calibration = parse_calibration(calib_text)
        labels = parse_labels(texts[name], calibration)
        assert format_labels(labels, calibration) == texts[name], name
        # from the float32 LiDAR boxes alone only the sign of a zero may be lost
        assert labels.attributes is not None
        bare = replace(labels, attributes=replace(labels.attributes, camera=None))
        again = format_labels(bare, calibration)
        assert again.replace("-0.00", "0.00") == texts[name].replace("-0.00", "0.00"), name
        ours, theirs = format_calibration(calibration).splitlines(), calib_text.splitlines()
        assert [ours[k] for k in (2, 4, 5)] == [theirs[k] for k in (2, 4, 5)], name


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_boxes_survive_the_camera_frame(count: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    boxes = torch.rand(count, 7, generator=generator, dtype=torch.float64)
    boxes = boxes * torch.tensor([70.0, 80, 3, 5, 2, 3, 6.2]) + torch.tensor([0.0, -40, -2, 0.1, 0.1, 0.1, -3.1])
    camera = CALIB.to_camera(boxes)
    again = CALIB.from_camera(camera.location, camera.size, camera.rotation_y)
    torch.testing.assert_close(again, boxes, atol=1e-9, rtol=0)


def test_labels_without_attributes_are_written_with_what_follows_from_the_box() -> None:
    labels = Labels(torch.tensor([[20.0, 0, -1, 4, 2, 1.5, 0]]), ("Car",))
    words = format_labels(labels, CALIB, (1242, 375)).split()
    assert words[:3] == ["Car", "0.00", "0"]
    again = parse_labels(" ".join(words), CALIB)
    torch.testing.assert_close(again.boxes, labels.boxes, atol=0.006, rtol=0)
    assert again.attributes is not None
    left, top, right, bottom = again.attributes.image[0].tolist()
    assert 0 <= left < 640 < right <= 1241 and 0 <= top < bottom <= 374


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CAR + "Car 0 0 1\n", "label_2/000012.txt, line 2: expected 15 or 16 columns, got 4"),
        (CAR.replace("58.49", "x"), 'label_2/000012.txt, line 1: expected numbers, got "x"'),
        (CAR.replace("58.49", "nan"), 'label_2/000012.txt, line 1: expected finite numbers, got "nan"'),
        (CAR.replace("1.87", "1e10"), "line 1: expected metres, pixels and radians, got 1e+10"),
        (
            CAR.replace("1.87", "-1"),
            "line 1: height, width and length (columns 9 to 11) must be at least 0, got 1.67 -1 ",
        ),
    ],
)
def test_a_bad_label_line_is_named(text: str, message: str) -> None:
    with pytest.raises(BeamboxError) as caught:
        parse_labels(text, CALIB, "label_2/000012.txt")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("P2:", "P9:"), "calib.txt: expected a line `P2:` with 12 numbers, got none"),
        (("R0_rect: ", "R0_rect: 1 "), "calib.txt, line 5: expected 9 numbers for `R0_rect`, got 10"),
        (("R0_rect: ", "R0_rect: one "), 'calib.txt, line 5 (R0_rect): expected numbers, got "one"'),
    ],
)
def test_a_bad_calibration_line_is_named(change: tuple[str, str], message: str) -> None:
    with pytest.raises(BeamboxError) as caught:
        parse_calibration(format_calibration(CALIB).replace(*change), "calib.txt")
    assert message in str(caught.value)


def test_a_calibration_without_inverse_is_refused() -> None:
    flat = replace(CALIB, r0=torch.zeros(3, 3))
    with pytest.raises(BeamboxError, match=r"calib\.txt: expected rotations in `R0_rect` and `Tr_velo_to_cam`"):
        parse_calibration(format_calibration(flat), "calib.txt")


WORD = st.sampled_from(
    ["Car", "DontCare", "-1", "0.5", "1e300", "nan", "-inf", "1e40", "P2:", "R0_rect:", "x", "\x00", "é"]
)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.lists(WORD, max_size=17).map(" ".join), max_size=4).map("\n".join), st.integers(0, 1500), st.text())
def test_no_text_makes_a_parser_fail_otherwise(noise: str, place: int, letters: str) -> None:
    calib = format_calibration(CALIB)
    for text in (noise, CAR + noise, CAR[: place % len(CAR)] + letters + CAR[place % len(CAR) :]):
        for parse in (parse_labels, parse_results):
            with contextlib.suppress(BeamboxError):
                parse(text, CALIB)
    for text in (noise, calib[:place] + letters + calib[place:], calib[:place] + noise + calib[place + 9 :]):
        with contextlib.suppress(BeamboxError):
            parse_calibration(text).rect_to_lidar(torch.zeros(1, 3))
        with contextlib.suppress(BeamboxError):
            parse_plane(text, CALIB)


def test_results_become_detections() -> None:
    line = CAR.strip() + " 0.75\n"
    found = parse_results(line, CALIB, ("Pedestrian", "Car"), frame_id="000001")
    assert found.names == ["Car"] and found.scores.tolist() == [0.75] and found.class_ids.tolist() == [1]
    with pytest.raises(BeamboxError, match="expected 16 columns, got 15"):
        parse_results(CAR, CALIB)
    with pytest.raises(BeamboxError, match=r'unknown class "Car" \(did you mean "Cat"\?\)'):
        parse_results(line, CALIB, ("Cat",))
    assert len(parse_results("", CALIB)) == 0


def test_a_written_frame_is_read_again(tmp_path: Path) -> None:
    written = frame()
    write_kitti_frame(tmp_path, written)
    write_split(tmp_path, "train", ["000007"])
    source = KittiSource(tmp_path, "train")
    assert list(source.ids) == ["000007"] and len(source) == 1
    read = source[0]
    assert torch.equal(read.points, written.points)
    assert read.labels is not None and written.labels is not None
    assert torch.equal(read.labels.boxes, written.labels.boxes) and read.labels.names == ("Car",)
    assert len(read.labels.ignored_image) == 1
    assert read.image_size == (1242, 375) and read.image_path is None
    assert not list(tmp_path.rglob("*.part"))


def test_the_camera_view_keeps_what_projects_into_the_image(tmp_path: Path) -> None:
    write_kitti_frame(tmp_path, frame(points=500))
    whole, seen = KittiSource(tmp_path, "all")[0], KittiSource(tmp_path, "all", fov=True)[0]
    pixels, depth = CALIB.rect_to_image(CALIB.lidar_to_rect(whole.points[:, :3]))
    u, v = pixels.T
    inside = (u >= 0) & (u < 1242) & (v >= 0) & (v < 375) & (depth >= 0)
    assert 0 < len(seen) < 500
    assert torch.equal(seen.points, whole.points[inside])


def test_points_alone_need_no_calibration(tmp_path: Path) -> None:
    write_kitti_frame(tmp_path, frame())
    (tmp_path / "training/calib/000007.txt").unlink()
    with pytest.raises(MissingFileError, match="cannot be placed among the points"):
        KittiSource(tmp_path, "all")[0]
    with pytest.raises(MissingFileError, match=r"camera's view \(fov=True\) needs it"):
        KittiSource(tmp_path, "all", fov=True)[0]
    read = KittiSource(tmp_path, "all", labels=False)[0]
    assert len(read) == 50 and read.labels is None and "points alone do not" in read.notes[0]


def test_missing_things_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="is not a folder; expected one that holds training/velodyne"):
        KittiSource(tmp_path / "nowhere")
    with pytest.raises(MissingFileError, match=r"must hold training/velodyne \(KITTI's layout\), but holds nothing"):
        KittiSource(tmp_path)
    write_kitti_frame(tmp_path, frame())
    write_split(tmp_path, "train", ["000007", "000008"])
    with pytest.raises(MissingFileError, match=r'no split "trian" \(did you mean "train"\?\)'):
        KittiSource(tmp_path, "trian")
    with pytest.raises(MissingFileError, match=r"velodyne.000008.bin is not there"):
        KittiSource(tmp_path, "train")[1]
    write_split(tmp_path, "train", ["000007", "000007"])
    with pytest.raises(BeamboxError, match="must name each frame once, but names 000007 again"):
        KittiSource(tmp_path, "train")


def test_the_test_split_lies_in_testing(tmp_path: Path) -> None:
    write_kitti_frame(tmp_path, replace(frame("000000"), labels=None), part="testing")
    source = KittiSource(tmp_path, "test", fov=True)
    assert source[0].labels is None and source[0].id == "000000"


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    broken = frame()
    broken.points[3, 1] = float("nan")
    broken.points[9, 3] = float("inf")
    write_kitti_frame(tmp_path, broken)
    read = KittiSource(tmp_path, "all")[0]
    assert len(read) == 49 and read.notes == (
        "clipped 1 of 50 intensities to [0, 1]",
        "dropped 1 of 50 points that are NaN or infinite",
    )


def test_the_image_size_comes_from_the_png_header(tmp_path: Path) -> None:
    path = tmp_path / "training" / "image_2" / "000007.png"
    write_kitti_frame(tmp_path, frame())
    path.parent.mkdir()
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 1224, 370))
    read = KittiSource(tmp_path, "all")[0]
    assert read.image_size == (1224, 370) and read.image_path == path
    path.write_bytes(b"GIF89a")
    with pytest.raises(BeamboxError, match="must be a PNG image"):
        png_size(path)


def test_a_road_plane_file_is_carried_to_the_lidar() -> None:
    plane = parse_plane("# Plane\nWidth 4\nHeight 1\n0.0 -1.0 0.0 1.65\n", CALIB)
    torch.testing.assert_close(plane, torch.tensor([0, 0, 1, 1.65 + 0.08]))
    with pytest.raises(BeamboxError, match="plane, line 1: expected 4 numbers a b c d of the road plane, got 3"):
        parse_plane("1 2 3\n", CALIB)
    with pytest.raises(BeamboxError, match="got one that stands upright"):
        parse_plane("1 0 0 3\n", CALIB)


def test_every_real_frame_reads() -> None:
    source = KittiSource(data_dir("kitti"), "val", fov=True)
    for index in range(0, len(source), 6):
        read = source[index]
        plane = fit_ground_plane(read.points)
        assert read.labels is not None and read.plane is None and read.image_size is not None
        assert len(read) > 5000 and float(read.points[:, 3].max()) <= 1
        assert plane is not None and 1.4 < float(plane[3]) < 2.1  # the sensor stands 1.73 m above the road
