"""The C++ example prints the boxes that Python finds: built and run with whichever runtime is here."""

from __future__ import annotations

import os
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("onnx")
pytest.importorskip("onnxscript")

from beambox.export.onnx_file import export_onnx
from beambox.infer.predictor import Detector
from beambox.structures import Detections
from oracles.paths import ROOT
from oracles.same_boxes import expect_same_boxes
from oracles.tiny_detector import street, tiny_model

TOLERANCE = 1e-4


def runtime() -> list[str]:
    """Return what tells CMake where a runtime with headers lies; skips where there is none."""
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        pytest.skip("no cmake or no C++ compiler here")
    if root := os.environ.get("ONNXRUNTIME_ROOT"):
        return [f"-DONNXRUNTIME_ROOT={root}", "-DBEAMBOX_RUNTIME=onnxruntime"]
    spec = find_spec("openvino")
    if spec is not None and spec.origin is not None:
        return [f"-DOpenVINO_DIR={Path(spec.origin).parent / 'cmake'}", "-DBEAMBOX_RUNTIME=openvino"]
    pytest.skip(
        "neither onnxruntime's C++ headers (ONNXRUNTIME_ROOT; no Python wheel has them) nor the package openvino"
    )


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    build = tmp_path_factory.mktemp("cpp")
    for words in (["-S", str(ROOT / "examples" / "cpp"), "-B", str(build), *runtime()], ["--build", str(build)]):
        done = subprocess.run(["cmake", *words], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "warning" not in done.stderr, done.stderr
    return build / "beambox_detect"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "tiny.onnx"
    export_onnx(tiny_model(), path)
    return path


def run(program: Path, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([program, *map(str, words)], capture_output=True, text=True, check=False)


def detections(text: str, classes: tuple[str, ...]) -> Detections:
    rows = [line.split() for line in text.splitlines()]
    numbers = torch.tensor([[float(word) for word in row[1:]] for row in rows])
    return Detections(numbers[:, 1:], numbers[:, 0], [classes.index(row[0]) for row in rows], classes)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_prints_the_boxes_that_python_finds(program: Path, exported: Path, tmp_path: Path, seed: int) -> None:
    points = street(seed)
    points[::1000, 3] = np.nan  # an unknown intensity is 0 on both sides
    points[5::1000, 0] = np.nan  # no place, no point
    points.tofile(tmp_path / "scan.bin")
    wanted = Detector(tiny_model(), device="cpu", precision="float32")(tmp_path / "scan.bin")
    done = run(program, exported, tmp_path / "scan.bin")
    assert done.returncode == 0, done.stderr
    expect_same_boxes(detections(done.stdout, wanted.classes), wanted, TOLERANCE)


def test_empty_and_broken_files(program: Path, exported: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.bin").write_bytes(b"")
    (tmp_path / "cut.bin").write_bytes(bytes(17))
    (tmp_path / "cut.onnx").write_bytes(exported.read_bytes()[:5000])
    assert (run(program, exported, tmp_path / "empty.bin").stdout, run(program).returncode) == ("", 2)
    for model, scan, words in (
        (exported, tmp_path / "cut.bin", "whole points of 4 float32 numbers, but has 17 bytes"),
        (exported, tmp_path / "absent.bin", "cannot be read"),
        (tmp_path / "cut.onnx", tmp_path / "empty.bin", "cut short, or no ONNX file"),
    ):
        done = run(program, model, scan)
        assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1
