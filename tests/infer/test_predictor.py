"""The detector a user holds: every kind of input, options that change what it sees, and errors that help."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import beambox
from beambox import BeamboxError, Detections, Frame, VoxelGrid
from beambox.detectors.pointpillars import PointPillars
from beambox.detectors.weights import save_weights
from beambox.infer.predictor import Detector, load, region
from beambox.zoo import find_weights
from oracles.tiny_detector import GRID, kitti_folder, street, tiny_model, tiny_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def detector(weights: Path) -> Detector:
    return load(weights, device="cpu", precision="float32")


def same(a: Detections, b: Detections) -> bool:
    return torch.equal(a.boxes, b.boxes) and torch.equal(a.scores, b.scores) and a.names == b.names


def nearly(a: Detections, b: Detections, shift: tuple[float, float, float] = (0, 0, 0)) -> bool:
    """Whether two sets of detections agree but for rounding, and for the order and choice of equals that follows."""
    there = torch.cdist(a.boxes[:, :3].double() - torch.tensor(shift), b.boxes[:, :3].double()).amin(dim=1) < 0.01
    return abs(len(a) - len(b)) <= 1 and int((~there).sum()) <= 1


def test_path_array_tensor_frame_and_list_agree(detector: Detector, tmp_path: Path) -> None:
    points = street()
    points.tofile(tmp_path / "scan.bin")
    found = detector(tmp_path / "scan.bin")
    assert len(found) > 3, "or this test proves nothing"
    assert found.frame_id == "scan"
    others = detector([str(tmp_path / "scan.bin"), points, torch.from_numpy(points), Frame(torch.from_numpy(points))])
    assert all(same(found, other) for other in others)
    assert detector([]) == []


def test_double_precision_arrays_are_taken(detector: Detector) -> None:
    points = street()
    assert same(detector(points), detector(points.astype(np.float64)))


def test_it_detects_what_the_bare_model_detects(detector: Detector) -> None:
    frame = Frame(torch.from_numpy(street()))
    model = tiny_model()
    with torch.inference_mode():
        plain = model.decode(model(beambox.Batch.of([frame])))[0]
    found = detector(frame)
    assert nearly(plain, found)


def test_sweeps_that_pass_together_are_detected_as_alone(weights: Path) -> None:
    together = load(weights, device="cpu", precision="float32", batch_size=3)
    sweeps = [street(k) for k in range(4)]
    for a, b in zip(together(sweeps), [together(sweep) for sweep in sweeps]):
        assert nearly(a, b)


def test_the_model_that_was_given_is_not_changed() -> None:
    model = tiny_model()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    Detector(model, device="cpu")(street())
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_no_points_are_no_detections(detector: Detector) -> None:
    found = detector(np.zeros((0, 4), dtype=np.float32))
    assert len(found) == 0 and found.classes == ("Car", "Pedestrian", "Cyclist")


def test_points_out_of_range_are_no_detections_and_a_warning_that_names_doctor(
    detector: Detector, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="beambox"):
        detector(street() + np.array([500, 0, 0, 0], dtype=np.float32))
    assert "none of its 16900 points lies in the region" in caplog.text and "beambox doctor" in caplog.text


def test_points_that_are_not_finite_are_dropped_and_counted(
    detector: Detector, caplog: pytest.LogCaptureFixture
) -> None:
    points = street()
    spoilt = np.concatenate((points, np.full((7, 4), np.nan, dtype=np.float32)))
    with caplog.at_level(logging.INFO, logger="beambox"):
        assert same(detector(spoilt), detector(points))
    assert "dropped 7 of 16907 points that are NaN or infinite" in caplog.text


def test_arrays_of_another_shape_and_other_things_are_refused(detector: Detector) -> None:
    with pytest.raises(BeamboxError, match="got dict"):
        detector({"points": street()})  # type: ignore[arg-type]
    with pytest.raises(BeamboxError, match="shape"):
        detector(street()[:, :2])


def test_sensor_height_finds_the_same_at_another_height(weights: Path, detector: Detector) -> None:
    higher = street() - np.array([0, 0, 0.5, 0], dtype=np.float32)  # a sensor half a metre higher sees all lower
    corrected = load(weights, device="cpu", precision="float32", sensor_height=1.73 + 0.5)
    assert nearly(detector(street()), corrected(higher), (0, 0, 0.5))


def test_sensor_height_is_relative_to_what_the_card_says(tmp_path: Path) -> None:
    assert load(tiny_weights(tmp_path, sensor_height=2.0), sensor_height=2.5).alignment.z_offset == pytest.approx(0.5)


def test_axes_find_the_same_in_another_frame(weights: Path, detector: Detector) -> None:
    points = street()
    turned = points[:, [1, 0, 2, 3]] * np.array([-1, 1, 1, 1], dtype=np.float32)  # x: right, y: forward
    found = load(weights, device="cpu", precision="float32", axes="x: right, y: forward")(turned)
    plain = detector(points)
    boxes = plain.boxes[:, [1, 0, 2, 3, 4, 5, 6]] * torch.tensor([-1, 1, 1, 1, 1, 1, 1])
    assert len(found) > 3 and nearly(Detections(boxes, plain.scores, plain.class_ids, plain.classes), found)


def test_intensity_scale_undoes_another_unit(weights: Path, detector: Detector) -> None:
    percent = street() * np.array([1, 1, 1, 100], dtype=np.float32)
    found = load(weights, device="cpu", precision="float32", intensity_scale=0.01)(percent)
    assert nearly(found, detector(street()))
    frame = Frame(torch.from_numpy(percent))
    assert len(load(weights, device="cpu", precision="float32", intensity_scale=0.01)(frame)) == len(found)


def test_range_looks_behind(weights: Path, detector: Detector) -> None:
    behind = street() * np.array([-1, 1, 1, 1], dtype=np.float32)
    around = load(weights, device="cpu", precision="float32", range=20)
    assert (around(behind).boxes[:, 0] < -1).any()
    assert not (detector(behind).boxes[:, 0] < -3).any()
    assert around.grid.cell == detector.grid.cell


@pytest.mark.parametrize("absolute_xy", [False, True])
def test_networks_that_know_positions_warn_beyond_the_trained_region(
    absolute_xy: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "other.safetensors"
    save_weights(path, PointPillars(replace(tiny_model().config, absolute_xy=absolute_xy)))
    with caplog.at_level("WARNING", logger="beambox"):
        load(path, range=[0, -8, 16, 8])
        assert not caplog.records, "part of the trained region"
        load(path, range=20)
    assert [("absolute_xy" in record.getMessage()) for record in caplog.records] == [True] * absolute_xy


def test_region_rounds_outwards_to_whole_steps_in_phase_with_training() -> None:
    grid = region(GRID, (-10, -10, 30.0, 10))
    assert grid.minimum == (-12.0, -12.0, -3.0) and grid.maximum == (32.0, 12.0, 1.0)
    assert all(n % 8 == 0 for n in grid.size[:2])
    assert region(GRID, 16).minimum[:2] == (-16.0, -16.0)
    assert region(GRID, grid) is grid


def test_region_refuses_other_cells_and_other_counts_of_numbers() -> None:
    with pytest.raises(BeamboxError, match=r"cells of \(0.5, 0.5, 4.0\) m as in training"):
        region(GRID, VoxelGrid((0, 0, 0), (1, 1, 1), (0.1, 0.1, 1)))
    with pytest.raises(BeamboxError, match="x_min, y_min, x_max, y_max"):
        region(GRID, (1, 2, 3))
    with pytest.raises(BeamboxError, match="minimum < maximum"):
        region(GRID, (10, 0, -10, 5))


def test_camera_view_is_taken_where_a_calibration_lies_beside(weights: Path, tmp_path: Path) -> None:
    path = kitti_folder(tmp_path) / "000000.bin"
    auto, full = load(weights, device="cpu"), load(weights, device="cpu", view="full")
    frame = auto.read(path)
    assert frame.image_size == (1200, 360)
    assert len(auto.prepare(frame)) < len(frame) == len(full.prepare(frame))
    around = load(weights, device="cpu", range=20)
    assert not around.sees_camera_only(frame), "who looks behind does not want the camera's view alone"


def test_camera_view_without_a_calibration_says_what_is_missing(weights: Path) -> None:
    with pytest.raises(BeamboxError, match="no camera calibration"):
        load(weights, device="cpu", view="camera")(street())


def test_lower_precision_finds_nearly_the_same(weights: Path, detector: Detector) -> None:
    frame = Frame(torch.from_numpy(street()))
    exact = detector.predict(beambox.Batch.of([frame]))
    lower = load(weights, device="cpu", precision="bfloat16")
    rounded = lower.predict(beambox.Batch.of([frame]))
    assert rounded.cls.dtype == torch.bfloat16
    assert (torch.sigmoid(exact.cls) - torch.sigmoid(rounded.cls.float())).abs().max() < 0.05
    assert len(lower(frame)) > 0


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("device", "gpu", 'unknown device "gpu"'),
        ("precision", "bf16", 'unknown precision "bf16"'),
        ("view", "front", 'unknown view "front"'),
        ("axes", "sideways", "axes must say where x and y lead"),
    ],
)
def test_unknown_options_are_refused(weights: Path, option: str, value: str, message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        load(weights, **{option: value})  # type: ignore[arg-type]


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_gpu_that_is_not_there_is_said(weights: Path) -> None:
    with pytest.raises(BeamboxError, match=r'device "cuda" cannot be used: .*; use cpu'):
        load(weights, device="cuda")


def test_unknown_weights_name_the_nearest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("beambox.zoo.shipped", lambda: {"pointpillars-sim": tmp_path / "p.safetensors"})
    with pytest.raises(BeamboxError, match=r'no weights are called "pointpilars-sim".*did you mean "pointpillars-sim"'):
        find_weights("pointpilars-sim")
    assert find_weights("pointpillars-sim") == tmp_path / "p.safetensors"


def test_checkpoints_of_others_and_broken_files_are_refused(tmp_path: Path, weights: Path) -> None:
    (tmp_path / "model.pth").write_bytes(b"PK..")
    with pytest.raises(BeamboxError, match=r"is a PyTorch checkpoint; beambox reads \.safetensors"):
        load(tmp_path / "model.pth")
    (tmp_path / "short.safetensors").write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(BeamboxError, match=r"short\.safetensors"):
        load(tmp_path / "short.safetensors")


def test_the_folder_of_a_run_gives_its_best_weights(tmp_path: Path, weights: Path) -> None:
    with pytest.raises(BeamboxError, match="folder with 0 weight files"):
        find_weights(tmp_path)
    for name in ("final.safetensors", "best.safetensors"):
        (tmp_path / name).write_bytes(weights.read_bytes())
        assert find_weights(tmp_path) == tmp_path / name
