"""What carries data to a borrowed GPU and checkpoints back loses nothing; the benchmark outlives what fails in it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from beambox.train.checkpoint import Checkpoint, load_checkpoint
from oracles.paths import ROOT

BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the scripts be imported as they import each other."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def sweep(count: int, seed: int = 0) -> np.ndarray:
    """A sweep as KITTI writes it: whole millimetres and hundredths, zeros with a minus among them."""
    rng = np.random.default_rng(seed)
    points = np.empty((count, 4), np.float32)
    points[:, :3] = (rng.integers(-80_000, 80_000, (count, 3)) / 1000).astype(np.float32)
    points[:, 3] = (rng.integers(0, 100, count) / 100).astype(np.float32)
    points[::7, 1], points[::11, 3] = -0.0, 0.0
    return points


@pytest.mark.usefixtures("scripts")
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_a_sweep_comes_back_byte_for_byte(count: int) -> None:
    from pack_frames import decode, encode

    points = sweep(count)
    data = encode(points)
    assert decode(data).tobytes() == points.tobytes()
    assert count < 5000 or len(data) < 0.7 * points.nbytes  # of numbers at random; real sweeps shrink to a fifth


@pytest.mark.usefixtures("scripts")
@pytest.mark.parametrize(("column", "value"), [(0, 1.00005), (3, 0.005), (3, -0.01)])
def test_what_packing_would_change_is_refused(column: int, value: float) -> None:
    from pack_frames import encode

    points = sweep(20)
    points[3, column] = value
    with pytest.raises(SystemExit, match="packing would change it"):
        encode(points)


@pytest.mark.usefixtures("scripts")
def test_a_data_set_is_packed_and_unpacked(tmp_path: Path) -> None:
    from pack_frames import pack, unpack

    names = ["000003", "000007"]
    for kind, ending in (("velodyne", "bin"), ("calib", "txt"), ("label_2", "txt")):
        (tmp_path / "kitti" / "training" / kind).mkdir(parents=True)
        for seed, name in enumerate(names):
            file = tmp_path / "kitti" / "training" / kind / f"{name}.{ending}"
            file.write_bytes(sweep(300, seed).tobytes() if ending == "bin" else f"{kind} {name}\n".encode())
    (tmp_path / "kitti" / "ImageSets").mkdir()
    (tmp_path / "kitti" / "ImageSets" / "train.txt").write_text("".join(f"{name}\n" for name in names))
    pack(tmp_path / "kitti", tmp_path / "kitti.pack", ["train"])
    assert unpack(tmp_path / "kitti.pack", tmp_path / "there") == ["train"]
    before = {p.relative_to(tmp_path / "kitti"): p.read_bytes() for p in (tmp_path / "kitti").rglob("*.*")}
    after = {p.relative_to(tmp_path / "there"): p.read_bytes() for p in (tmp_path / "there").rglob("*.*")}
    assert after == before


@pytest.mark.usefixtures("scripts")
def test_a_packed_file_writes_nowhere_else(tmp_path: Path) -> None:
    from pack_frames import unpack

    with zipfile.ZipFile(tmp_path / "bad.pack", "w") as archive:
        archive.writestr("../outside.txt", "x")
    with pytest.raises(SystemExit, match="outside the folder"):
        unpack(tmp_path / "bad.pack", tmp_path / "there")
    assert not (tmp_path / "outside.txt").exists()


@pytest.mark.usefixtures("scripts")
def test_a_checkpoint_travels_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import gpu_train

    monkeypatch.setattr(gpu_train, "PART", 1000)
    tensors = {"model.w": torch.randn(700), "optim.w.exp_avg": torch.randn(700), "optim.w.step": torch.tensor(5.0)}
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "checkpoint.9").write_bytes(b"of a former, larger one")
    Checkpoint(tensors, 5, {"seed": 1}, {"name": "x"}, {"best": None}).save(tmp_path / "last.safetensors")
    gpu_train.bring_home(tmp_path / "last.safetensors", tmp_path / "out")
    sizes = [path.stat().st_size for path in sorted((tmp_path / "out").iterdir())]
    assert len(sizes) > 3 and max(sizes) <= 1000
    gpu_train.take_along(tmp_path / "out", tmp_path / "run")
    back = load_checkpoint(tmp_path / "run" / "last.safetensors")
    assert back.tensors["model.w"].equal(tensors["model.w"]) and back.step == 5
    moment = back.tensors["optim.w.exp_avg"]
    assert moment.dtype == torch.float32 and moment.equal(tensors["optim.w.exp_avg"].bfloat16().float())


def test_the_benchmark_reports_what_fails_and_goes_on(tmp_path: Path) -> None:
    """A tool is taken from under one group; each of its items is told as failed, and the other group is not touched."""
    command = [sys.executable, str(BENCHMARKS / "gpu.py"), "--out", str(tmp_path), "--minutes", "2"]
    command += ["--only", "ops:voxels", "peaks", "--device", "cpu", "--quick"]
    lines = ("import sys", f"sys.path.insert(0, {str(BENCHMARKS)!r})", "import gpu_speed", "gpu_speed.timed = None")
    (tmp_path / "sitecustomize.py").write_text("\n".join(lines))  # Python runs it first, in every process
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240, env=environment)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "gpu.json").read_text())
    peaks = report["groups"]["peaks"]["items"]
    assert len(peaks) == 7 and all("error" in item for item in peaks.values())
    voxels = report["groups"]["ops:voxels"]["items"]
    assert len(voxels) == 5 and all(item["ok"] for item in voxels.values())
    assert "FAILED peaks" in done.stdout
