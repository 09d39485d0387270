"""Run the tests of the Triton kernels in a process of their own: the interpreter must be chosen before triton loads."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "interpreted"
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(find_spec("triton") is None, reason="triton is not installed; it is for Linux on x86-64")
@pytest.mark.parametrize("path", sorted(FOLDER.glob("triton_*.py")), ids=lambda path: path.stem)
def test_triton_kernels_in_the_interpreter(path):
    environment = {**os.environ, "TRITON_INTERPRET": "1", "BEAMBOX_BACKEND": "triton", "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(path)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
