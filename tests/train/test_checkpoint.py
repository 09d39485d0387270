"""Checkpoints survive failures of the disk, and only whole ones of the right model are taken."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from beambox.checks import BeamboxError, MissingFileError
from beambox.train.checkpoint import Checkpoint, load_checkpoint
from beambox.train.loop import LAST
from oracles.tiny_training import OPTIONS, recipe, tiny_run

resource = pytest.importorskip("resource", reason="file size limits are a matter of Unix")


def small() -> Checkpoint:
    return Checkpoint({"model.a": torch.arange(6.0).reshape(2, 3)}, 7, {"name": "x"}, {"name": "y"}, {"best": None})


def test_round_trip(tmp_path: Path) -> None:
    small().save(tmp_path / "a.safetensors")
    back = load_checkpoint(tmp_path / "a.safetensors")
    assert torch.equal(back.tensors["model.a"], small().tensors["model.a"])
    assert (back.step, back.recipe, back.detector, back.state) == (7, {"name": "x"}, {"name": "y"}, {"best": None})


def test_missing_truncated_pickled_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    with pytest.raises(MissingFileError, match="there is no checkpoint"):
        load_checkpoint(path)
    small().save(path)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(BeamboxError, match="damaged or cut short"):
        load_checkpoint(path)
    torch.save({"a": 1}, path)
    with pytest.raises(BeamboxError, match="unpickling can run any code"):
        load_checkpoint(path)
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(BeamboxError, match="unpickling can run any code"):
        load_checkpoint(path)
    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(BeamboxError, match="holds no state of a training run"):
        load_checkpoint(path)


@pytest.mark.parametrize("beginning", [b"\x80", b"PK"])
def test_a_length_of_the_header_that_looks_like_a_pickle_is_none(tmp_path: Path, beginning: bytes) -> None:
    path = tmp_path / "a.safetensors"
    for length in range(0, 20_000, 4):
        kept = Checkpoint({"model.a": torch.ones(2)}, 7, {"name": "x" * length}, {"name": "y"}, {"best": None})
        kept.save(path)
        with path.open("rb") as file:
            start = file.read(8)
        if start.startswith(beginning):
            break
        if beginning == b"PK" and int.from_bytes(start, "little") < 19_000:
            continue
    assert start.startswith(beginning)
    assert load_checkpoint(path).recipe == {"name": "x" * length}


def test_checkpoint_of_another_model_is_refused(tmp_path: Path) -> None:
    tiny_run(tmp_path).save()
    wider = {**OPTIONS, "widths": [8, 16]}
    run_recipe = recipe()
    run_recipe = run_recipe.model_copy(update={"detector": run_recipe.detector.model_copy(update={"options": wider})})
    run = tiny_run(tmp_path, run_recipe)
    with pytest.raises(BeamboxError, match=r"last.safetensors holds the weights of another model: .* has shape"):
        run.restore()


def test_full_disk_leaves_the_former_checkpoint(tmp_path: Path) -> None:
    run = tiny_run(tmp_path)
    run.save()
    former = (tmp_path / LAST).read_bytes()
    run.step = 3
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(former) // 2, limits[1]))
    try:
        with pytest.raises(BeamboxError, match=r"cannot write .*last.safetensors.*the former checkpoint is intact"):
            run.save()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / LAST).read_bytes() == former
    assert [path.name for path in tmp_path.iterdir()] == [LAST]
    assert load_checkpoint(tmp_path / LAST).step == 0
