import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from beambox.checks import BeamboxError, MissingFileError
from beambox.detectors.catalog import build, config_from_dict, config_to_dict
from beambox.detectors.pointpillars import PointPillarsConfig
from beambox.detectors.voxel_rcnn import VoxelRCNNConfig
from beambox.detectors.weights import fill, load_weights, read_weights, save_weights

OPTIONS = {"widths": [8, 8, 8], "up_widths": [8, 8, 8], "voxel_channels": 8, "depths": [0, 0, 0]}


def test_weights_come_back_with_their_configuration(tmp_path: Path) -> None:
    model = build("pointpillars", OPTIONS)
    save_weights(tmp_path / "w.safetensors", model, {"licence": "Apache-2.0"})
    again = load_weights(tmp_path / "w.safetensors")
    assert again.config == model.config
    assert read_weights(tmp_path / "w.safetensors").card == {"licence": "Apache-2.0"}
    for name, value in model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
    assert not again.training


def test_half_precision_files_are_half_as_large_and_load_as_float32(tmp_path: Path) -> None:
    model = build("pointpillars", OPTIONS)
    save_weights(tmp_path / "full.safetensors", model)
    save_weights(tmp_path / "half.safetensors", model, half=True)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.7 * (tmp_path / "full.safetensors").stat().st_size
    assert all(p.dtype == torch.float32 for p in load_weights(tmp_path / "half.safetensors").parameters())


def test_a_missing_file_says_where_to_look(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="beambox models"):
        load_weights(tmp_path / "none.safetensors")


@pytest.mark.parametrize("content", [b"", b"not a weight file", b"\x80\x04\x95pickled", bytes(range(256)) * 9])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(content)
    with pytest.raises(BeamboxError, match="not a readable weight file"):
        load_weights(path)


def test_a_truncated_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(path, build("pointpillars", OPTIONS))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BeamboxError, match="not a readable weight file"):
        load_weights(path)


def test_foreign_safetensors_are_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, str(tmp_path / "a.safetensors"))
    with pytest.raises(BeamboxError, match="not one of beambox's"):
        load_weights(tmp_path / "a.safetensors")


def test_tensors_of_another_model_are_refused_by_name_and_shape() -> None:
    model, wider = build("pointpillars", OPTIONS), build("pointpillars", {**OPTIONS, "voxel_channels": 16})
    with pytest.raises(BeamboxError, match=r"has shape \(16, .*expected \(8, "):
        fill(model, wider.state_dict(), "file")
    with pytest.raises(BeamboxError, match="lacks"):
        fill(model, {}, "file")


def test_a_full_disk_leaves_the_old_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "w.safetensors"
    model = build("pointpillars", OPTIONS)
    save_weights(path, model)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(BeamboxError, match="No space left on device"):
        save_weights(path, model)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["w.safetensors"]


def test_configurations_survive_plain_values() -> None:
    config = PointPillarsConfig(widths=(1, 2, 3), centered_anchors=True)
    assert config_from_dict(PointPillarsConfig, config_to_dict(config)) == config


def test_settings_given_in_part_keep_the_defaults_of_the_detector() -> None:
    config = config_from_dict(VoxelRCNNConfig, {"post": {"score_threshold": 0.2}, "sampling": {"rois_per_frame": 8}})
    assert config.post == replace(VoxelRCNNConfig().post, score_threshold=0.2)  # of its kind alone: overlap up to 0.01
    assert config.post.nms_iou == 0.1
    assert config.sampling == replace(VoxelRCNNConfig().sampling, rois_per_frame=8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": [1, 2, 3]}, 'no field "width".*did you mean "widths"'),
        ({"grid": {"cel": [1, 1, 1]}}, 'no field "grid.cel".*did you mean "cell"'),
        ({"post": {"nms_io": 0.1}}, 'no field "post.nms_io".*did you mean "nms_iou"'),
        ({"max_points": "many"}, "max_points"),
        ({"depths": [1]}, "same length"),
        ({"up_strides": [1, 2, 2]}, r"with strides \[2, 2, 2\] they are \[1, 2, 4\], got \[1, 2, 2\]"),
    ],
)
def test_wrong_options_are_named(options: dict, message: str) -> None:
    with pytest.raises(BeamboxError, match=message):
        build("pointpillars", options)


def test_unknown_detectors_are_refused_with_the_nearest() -> None:
    with pytest.raises(BeamboxError, match='did you mean "pointpillars"'):
        build("pointpilars")
