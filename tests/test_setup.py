"""The set-up works for a stranger: from the public index alone, on every Python at hand, whatever this machine has."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from oracles.paths import ROOT

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
HELP = ("FIND_LINKS", "CONSTRAINT", "EXTRA_INDEX_URL", "INDEX_URL", "NO_INDEX", "REQUIREMENT")
UNREACHABLE = ("NewConnectionError", "Connection broken", "ConnectTimeout", "Temporary failure", "Connection refused")


def stranger() -> dict[str, str]:
    """Return the environment without what a machine may lend to pip: only the way to the index stays."""
    env = {name: value for name, value in os.environ.items() if name not in {f"PIP_{word}" for word in HELP}}
    return {**env, "PIP_CONFIG_FILE": os.devnull, "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PYTHONPATH": ""}


@functools.cache
def interpreter(version: str) -> str | None:
    """Return a Python of this version that has pip: on the path, or one of pyenv's."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    found = [shutil.which(f"python{version}"), *map(str, sorted(pyenv.glob(f"versions/{version}.*/bin/python")))]
    for path in filter(None, found):  # a shim of pyenv may be there without its Python
        asked = subprocess.run([path, "-m", "pip", "--version"], capture_output=True, text=True, check=False)
        if asked.returncode == 0 and f"(python {version})" in asked.stdout:
            return path
    return None


@pytest.mark.parametrize("version", PYTHONS)
def test_the_index_alone_gives_everything(version: str, tmp_path: Path) -> None:
    """`.[dev]` holds every extra, so that what resolves for it resolves for each of them."""
    python = interpreter(version)
    if python is None:
        pytest.skip(f"no Python {version} with pip here")
    report = tmp_path / "report.json"
    words = ["install", "--dry-run", "--ignore-installed", "--quiet", "--retries", "1", "--report", str(report)]
    done = subprocess.run(
        [python, "-m", "pip", *words, "-c", "constraints.txt", ".[dev]"],
        cwd=ROOT,
        env=stranger(),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode and any(word in done.stderr for word in UNREACHABLE):
        pytest.skip("the package index cannot be reached from here")
    assert done.returncode == 0, done.stderr[-2000:]
    actual = {one["metadata"]["name"].lower(): one for one in json.loads(report.read_text())["install"]}
    assert actual["torch"]["metadata"]["version"] == "2.13.0"
    assert not actual["torch"]["download_info"]["url"].startswith("file:"), "a wheel from this machine's disk came in"
    assert {"numba", "lightning-fabric", "pypcd4", "onnx", "pytest"} <= set(actual)


def test_every_pin_names_one_version_of_one_package_for_each_python() -> None:
    """Two pins of a package stand apart by their markers, so that no Python meets both."""
    from packaging.requirements import Requirement

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line) for line in lines if line and not line.startswith("#")]
    assert all(str(pin.specifier).startswith("==") and len(pin.specifier) == 1 for pin in pins)
    for version in PYTHONS:
        here = {"python_version": version, "python_full_version": f"{version}.9", "sys_platform": "linux"}
        names = [pin.name for pin in pins if pin.marker is None or pin.marker.evaluate(here)]
        assert len(names) == len(set(names))


def test_the_makefile_and_make_py_offer_the_same() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = next(line for line in makefile.splitlines() if line.startswith(".PHONY:")).split()[1:]
    for target in targets:
        asked = [sys.executable, "make.py", target, "--no-such-option"]
        done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 2
        assert "invalid choice" not in done.stderr, target
    assert {"demo", "test"} <= set(targets)
