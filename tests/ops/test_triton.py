"""Run the tests of the Triton kernels in a process of their own: the interpreter must be chosen before triton loads."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

FOLDER = Path(__file__).parent / "interpreted"
ROOT = Path(__file__).resolve().parents[2]


pytestmark = pytest.mark.skipif(
    find_spec("triton") is None, reason="triton is not installed; it is for Linux on x86-64"
)
EVERY_FILE = pytest.mark.parametrize("path", sorted(FOLDER.glob("triton_*.py")), ids=lambda path: path.stem)


def run_tests(path, **variables):
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(path)]
    environment = {**os.environ, "BEAMBOX_BACKEND": "triton", **variables}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


@EVERY_FILE
def test_triton_kernels_in_the_interpreter(path):
    run_tests(path, TRITON_INTERPRET="1", CUDA_VISIBLE_DEVICES="")


@EVERY_FILE
@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_triton_kernels_on_the_gpu(path):
    run_tests(path, TRITON_INTERPRET="0")
