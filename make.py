#!/usr/bin/env python3
"""What the Makefile does, on every system and without make: python make.py demo | test | docs | check | ...

Needs Python 3.10 or later and nothing else; everything goes into .venv, beside this file.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

HERE = Path(__file__).resolve().parent
VENV = HERE / ".venv"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
CONSTRAINTS = HERE / "constraints.txt"
SOURCES = ("src", "tests", "benchmarks", "make.py")
UV = "uv==0.13.9"  # resolves for all systems and Pythons at once, which pip does not


def run(*words: str) -> None:
    """Run the environment's Python with these arguments; leave with its status where it fails."""
    status = subprocess.run([str(PYTHON), *words], cwd=HERE, check=False).returncode
    if status:
        raise SystemExit(status)


def pip(*words: str) -> None:
    """Install into the environment, in the versions of constraints.txt."""
    run("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-c", str(CONSTRAINTS), *words)


def setup(extras: str = "train,formats,plots", marker: str = ".ready") -> None:
    """Make the environment and install this checkout into it; does nothing where both are up to date."""
    done = VENV / marker
    inputs = (HERE / "pyproject.toml", CONSTRAINTS)
    if done.exists() and all(done.stat().st_mtime >= path.stat().st_mtime for path in inputs):
        return
    if not PYTHON.exists():
        print(f"making {VENV} with Python {sys.version.split()[0]} ...", flush=True)
        venv.create(VENV, with_pip=True)
    print(f"installing beambox[{extras}]: minutes, and 230 MB to 3 GB of downloads, at the first time ...", flush=True)
    pip("-e", f".[{extras}]")
    done.touch()


def demo() -> None:
    """Set everything up, simulate traffic, detect, score, draw: see demo/."""
    setup()
    run("-m", "beambox", "demo", "--out", "demo")


def check() -> None:
    """Check style and types."""
    setup("dev", ".ready-dev")
    run("-m", "ruff", "check", *SOURCES)
    run("-m", "ruff", "format", "--check", *SOURCES)
    run("-m", "pyright", "--pythonpath", str(PYTHON))


def test() -> None:
    """Set everything up, check style and types, run the tests."""
    check()
    run("-m", "pytest", "-n", "2")


def test_slow() -> None:
    """Run the long tests."""
    setup("dev", ".ready-dev")
    run("-m", "pytest", "-m", "slow")


def docs() -> None:
    """Build the site from docs/ into site/, offline; a broken link or a page made from older code fails."""
    setup("dev", ".ready-dev")
    run("docs/make_site.py")


def constraints() -> None:
    """Write constraints.txt anew: for Python 3.10 and later on all systems, keeping each version that still fits.

    The public index alone is asked, whatever this machine is set to. A newer release of one package:
    python make.py constraints --upgrade-package torch
    """
    setup()
    run("-m", "pip", "install", "--quiet", "--disable-pip-version-check", UV)
    keep = {name: value for name, value in os.environ.items() if not name.startswith(("UV_", "PIP_"))}
    words = [str(PYTHON), "-m", "uv", "pip", "compile", "--quiet", "--no-config", "--universal"]
    words += ["--python-version", "3.10", "--extra", "dev", "--no-annotate"]
    words += ["--custom-compile-command", "python make.py constraints", "--output-file", CONSTRAINTS.name]
    words += [*ARGUMENTS, "pyproject.toml"]
    raise SystemExit(subprocess.run(words, cwd=HERE, env=keep, check=False, stdout=subprocess.DEVNULL).returncode)


def clean() -> None:
    """Remove what these commands made."""
    for name in (".venv", "demo", "build", "dist", "site"):
        shutil.rmtree(HERE / name, ignore_errors=True)


TASKS = {
    "setup": setup,
    "demo": demo,
    "check": check,
    "test": test,
    "test-slow": test_slow,
    "docs": docs,
    "constraints": constraints,
    "clean": clean,
}
ARGUMENTS: list[str] = []

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="make.py", description=__doc__)
    parser.add_argument("task", choices=TASKS)
    asked, ARGUMENTS = parser.parse_known_args()
    if ARGUMENTS and not (asked.task == "constraints" and ARGUMENTS[0].startswith("--upgrade")):
        parser.error(f"{asked.task} does not take {' '.join(ARGUMENTS)}")
    TASKS[asked.task]()
