"""Converting checkpoints: what fits is copied whole, what does not is refused with names and shapes."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, MissingFileError
from beambox.cli.import_openpcdet import command
from beambox.detectors.pointpillars import PointPillarsConfig
from beambox.detectors.weights import load_weights
from beambox.export.openpcdet import MODELS, import_checkpoint, read_checkpoint


def checkpoint_of(model: str, classes: int) -> tuple[nn.Module, dict[str, Tensor]]:
    """Draw a detector and name its tensors as OpenPCDet does."""
    torch.manual_seed(0)
    kind = MODELS[model]
    config = kind.config(classes)
    detector = kind.build(config)
    layers = dict(kind.names(config))
    state = {}
    for name, value in detector.state_dict().items():
        layer, _, leaf = name.rpartition(".")
        kernel = (3, 3, 3) if value.dim() == 3 and len(value) == 27 else (3, 1, 1)
        sparse = value.dim() == 3
        state[f"{layers[layer]}.{leaf}"] = value.unflatten(0, kernel).permute(4, 0, 1, 2, 3) if sparse else value
    return detector, state


def write(path, state):
    torch.save({"epoch": 80, "it": 1, "model_state": state, "version": "x"}, path)
    return path


@pytest.mark.parametrize("classes", [1, 3, 5])
@pytest.mark.parametrize("model", sorted(MODELS))
def test_every_tensor_arrives(tmp_path, model, classes):
    detector, state = checkpoint_of(model, classes)
    state["global_step"] = torch.tensor([7])
    read = import_checkpoint(write(tmp_path / "c.pth", state), model)
    assert len(read.config.classes) == classes
    for name, value in detector.state_dict().items():
        assert read.state_dict()[name].equal(value), name


def test_what_does_not_fit_is_refused_with_names_and_shapes(tmp_path):
    _, state = checkpoint_of("pointpillars", 3)
    del state["vfe.pfn_layers.0.norm.bias"]
    state["dense_head.conv_box.bias"] = torch.zeros(5)
    state["neck.weight"] = torch.zeros(2, 2)
    with pytest.raises(BeamboxError) as refusal:
        import_checkpoint(write(tmp_path / "c.pth", state), "pointpillars")
    text = str(refusal.value)
    assert "vfe.pfn_layers.0.norm.bias is missing" in text
    assert "dense_head.conv_box.bias has shape (5,), which does not make (42,)" in text
    assert "neck.weight (2, 2) is unknown" in text


def test_a_checkpoint_of_another_detector_is_refused(tmp_path):
    _, state = checkpoint_of("second", 3)
    path = write(tmp_path / "c.pth", state)
    with pytest.raises(BeamboxError, match=r"does not fit pointpillars.*vfe.pfn_layers.0.linear.weight is missing"):
        import_checkpoint(path, "pointpillars")
    with pytest.raises(BeamboxError, match=r'called "secnd" \(did you mean "second"\?\)'):
        import_checkpoint(path, "secnd")


class Harm:
    def __reduce__(self):
        return print, ("code of the checkpoint ran",)


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (b"not a checkpoint", "cannot read"),
        (pickle.dumps({"model_state": Harm()}), "cannot read"),
        (b"", "cannot read"),
    ],
)
def test_unreadable_files_are_refused_and_no_code_runs(tmp_path, content, pattern, capsys):
    path = tmp_path / "c.pth"
    path.write_bytes(content)
    with pytest.raises(BeamboxError, match=pattern):
        import_checkpoint(path, "second")
    assert capsys.readouterr().out == ""


def test_files_without_a_model_state_are_refused(tmp_path):
    path = tmp_path / "c.pth"
    torch.save({"state_dict": {}}, path)
    with pytest.raises(BeamboxError, match=r'must hold a dict "model_state".*state_dict'):
        import_checkpoint(path, "second")
    with pytest.raises(MissingFileError, match="no checkpoint"):
        import_checkpoint(tmp_path / "absent.pth", "second")
    write(path, {"dense_head.conv_cls.weight": torch.zeros(8, 4, 1, 1)})
    with pytest.raises(BeamboxError, match="head for 2 classes; known are 1"):
        import_checkpoint(path, "second")


def test_the_command_writes_a_weight_file(tmp_path, capsys):
    detector, state = checkpoint_of("pointpillars", 1)
    out = tmp_path / "deep" / "car.safetensors"
    command(write(tmp_path / "c.pth", state), "pointpillars", out)
    assert "pointpillars (Car)" in capsys.readouterr().out
    loaded = load_weights(out)
    assert isinstance(loaded.config, PointPillarsConfig)
    assert loaded.config.empty_slots
    assert loaded.head.cls.weight.equal(detector.head.cls.weight)


@pytest.mark.parametrize("numpy_1", [False, True])
def test_a_checkpoint_of_training_holds_numpy_numbers_and_is_read(tmp_path, numpy_1):
    """OpenPCDet's one-cycle schedule puts numpy.float64 into the optimizer's state; NumPy 1 pickles by another name."""
    detector, state = checkpoint_of("pointpillars", 3)
    numbers = [np.float64(0.9), np.float32(0.1), np.int64(3), np.bool_(True), np.uint8(7), np.float16(0.5)]
    path = tmp_path / "checkpoint_epoch_80.pth"
    torch.save({"epoch": 80, "model_state": state, "optimizer_state": {"param_groups": numbers}}, path)
    if numpy_1:
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "old.pth", "w") as new:
            for name in old.namelist():
                content = old.read(name)
                new.writestr(name, content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
        path = tmp_path / "old.pth"
    read = import_checkpoint(path, "pointpillars")
    assert all(value.equal(read.state_dict()[name]) for name, value in detector.state_dict().items())


def test_the_prefix_of_several_gpus_is_taken_off(tmp_path):
    detector, state = checkpoint_of("second", 1)
    read = import_checkpoint(write(tmp_path / "c.pth", {f"module.{k}": v for k, v in state.items()}), "second")
    assert all(value.equal(read.state_dict()[name]) for name, value in detector.state_dict().items())


def test_a_refusal_names_the_object_and_never_advises_to_run_it(tmp_path, capsys):
    _, state = checkpoint_of("second", 1)
    for harm in (Harm(), Path("x"), np.array([Harm()], dtype=object)):
        path = tmp_path / "c.pth"
        torch.save({"model_state": state, "harm": harm}, path)
        with pytest.raises(BeamboxError, match="only running code from the file would restore") as refusal:
            import_checkpoint(path, "second")
        assert "weights_only" not in str(refusal.value) and "\x1b" not in str(refusal.value)
        assert capsys.readouterr().out == ""


def test_mutants_of_a_checkpoint_are_refused_in_one_line(tmp_path):
    """Every part of a file may be broken; what is not noticed must still be numbers of the right shapes."""
    rng, path = np.random.default_rng(0), tmp_path / "c.pth"
    torch.save({"model_state": {"a": torch.zeros(3)}, "optimizer_state": [np.float64(1)]}, path)
    whole = path.read_bytes()
    for _ in range(60):
        content = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 6)):
            content[place] = rng.integers(0, 256)
        path.write_bytes(content[: rng.integers(1, len(whole) + 1)] if rng.random() < 0.2 else content)
        try:
            assert all(value.dim() <= 4 for value in read_checkpoint(path).values())
        except BeamboxError as error:
            assert "\n" not in str(error)
