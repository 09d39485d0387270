"""The wheel, installed away from the checkout: README and docs can be followed from there, in an empty folder.

Long commands are shortened, and nothing else: fewer frames, one step of training, one seed.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from oracles import pages
from oracles.paths import ROOT
from oracles.tiny_detector import street

SHORT = "--set optim.epochs=null --set optim.iterations=1 --set optim.batch=1 --set workers=0 --set augment=null"
LONGER = {  # what shortens a command: a pattern in its words, and what comes in its place
    "simulate": [
        (r"--frames \d+", "--frames 8"),
        (r"--sequence-length \d+", ""),
        (r"--format once", "--format once --sequence-length 2"),
    ],
    "train": [(r"$", f" {SHORT}")],
    "ablate": [(r"--seeds [\d,]+", "--seeds 0"), (r"$", " --iterations 1 --set optim.batch=1 --set augment=null")],
    "bench": [(r"$", " --runs 2")],
}
DRIVER = """
import glob, json, os, shlex, shutil, sys
import beambox
from beambox.cli.main import main
assert beambox.__file__.startswith(sys.prefix), beambox.__file__
for line in json.load(sys.stdin):
    words = [path for word in shlex.split(line) for path in (sorted(glob.glob(word)) if "*" in word else [word])]
    if words[0] in ("simulate", "train"):  # a reader's folder is not there yet
        made = words[1] if words[0] == "simulate" else words[words.index("--out") + 1] if "--out" in words else ""
        if made and "--resume" not in words:
            shutil.rmtree(made, ignore_errors=True)
    try:
        main(words)
        status = 0
    except SystemExit as left:
        status = left.code or 0
    sys.stdout.flush()
    print(f"beambox {line} -> {status}", file=sys.stderr, flush=True)
    if status:
        sys.exit(1)
"""


def outside(**more: str) -> dict[str, str]:
    """Return the environment without the ways back into the checkout."""
    env = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    return {**env, "OMP_NUM_THREADS": "1", **more}


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel as a release would."""
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    done = subprocess.run(words, capture_output=True, text=True, env=outside(), check=False)
    if done.returncode and ("No matching distribution found" in done.stderr or "No module named pip" in done.stderr):
        pytest.skip(f"the wheel cannot be built here: {done.stderr.splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="session")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel into an environment of its own; what it depends on is lent by the one that runs the tests.

    A folder named in a .pth file is searched, but the .pth files inside it are not read: an editable beambox stays out.
    """
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, with_pip=False)
    paths = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", "venv", paths))
    (site / "lent.pth").write_text("\n".join(sorted({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})))
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    words = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*words, "--ignore-installed", str(wheel)], check=True, env=outside())
    return python


def run(python: Path, folder: Path, lines: list[str]) -> str:
    """Run `beambox LINE` for each line, in one process that stands in ``folder``."""
    words = [str(python), "-c", DRIVER]
    done = subprocess.run(
        words, cwd=folder, input=json.dumps(lines), env=outside(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{done.stderr[-3000:]}\n{done.stdout[-1000:]}"
    return done.stdout


def shortened(words: list[str]) -> str:
    """Return the words after `beambox` as a line, shortened."""
    line = " ".join(word if re.fullmatch(r"[\w./:=,*-]+", word) else f"'{word}'" for word in words[1:])
    for pattern, instead in LONGER.get(words[1], []):
        line = re.sub(pattern, instead, line, count=1)
    return line.replace("/data/kitti", "kitti")


@pytest.fixture(scope="session")
def desk(python: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder that holds what the pages name: sweeps, a data set of each layout, a run, results."""
    folder = tmp_path_factory.mktemp("desk")
    for place in ("scans", "drive/first", "run"):
        (folder / place).mkdir(parents=True)
    points = street()
    for name in ("scan.bin", "scans/a.bin", "scans/b.bin", "drive/c.bin"):
        points.tofile(folder / name)
    head = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\n"
    text = "\n".join(" ".join(f"{value:.3f}" for value in row[:4]) for row in points)
    (folder / "drive" / "first" / "d.pcd").write_text(f"{head}POINTS {len(points)}\nDATA ascii\n{text}\n")
    outputs = [
        "simulate kitti --frames 10 --val-share 0.5",
        "simulate once --frames 8 --format once --sequence-length 4 --val-share 0.5",
    ]
    run(python, folder, [*outputs, "detect kitti --model pointpillars-sim --format kitti --out results"])
    shutil.copytree(folder / "kitti" / "training" / "label_2", folder / "label_2")
    shutil.copy(ROOT / "src" / "beambox" / "zoo" / "pointpillars-sim.safetensors", folder / "run" / "best.safetensors")
    for copy in ("DIR/kitti", "KITTI"):
        shutil.copytree(folder / "kitti", folder / copy)
    with tarfile.open(folder / "kitti_labels.tar.gz", "w:gz") as archive:
        for part in ("label_2", "calib"):
            archive.add(folder / "kitti" / "training" / part, f"training/{part}")
    recorded = ROOT / "tests" / "fixtures" / "once_eval" / "annotations.json.gz"
    (folder / "annotations.json").write_bytes(gzip.decompress(recorded.read_bytes()))
    return folder


PAGES = [page for page in pages.PAGES if any(b.commands and not b.mark for b in pages.blocks(page))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_of_a_page_run_one_after_the_other(page: Path, python: Path, desk: Path, tmp_path: Path) -> None:
    place = tmp_path / "here"
    shutil.copytree(desk, place)
    for block in pages.blocks(page):
        if block.language == "yaml" and "elevations" in block.text:
            (place / "mine.yaml").write_text(block.text, encoding="utf-8")
    lines = [words for block in pages.blocks(page) if not block.mark for words in block.commands]
    assert all(words[0] == "beambox" for words in lines), "another program has no place in this test"
    run(
        python, place, [shortened(words) for words in lines if "drive.bag" not in words]
    )  # tests/data/test_recording.py


def test_the_python_of_the_readme_runs(python: Path, desk: Path) -> None:
    (block,) = [one for one in pages.blocks(ROOT / "README.md") if one.language == "python"]
    words = [str(python), "-W", "error::DeprecationWarning", "-c", block.text]
    done = subprocess.run(words, cwd=desk, env=outside(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "tensor" in done.stdout


def test_the_wheel_holds_what_it_needs_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = [name for name in names if name.endswith(".dist-info/METADATA")]
        text = archive.read(metadata).decode()
    assert {
        "beambox/py.typed",
        "beambox/recipes/shipped/pointpillars-sim.yaml",
        "beambox/visualize/scene.html",
        "beambox/visualize/scene.js",
        "beambox/visualize/vendor/three-0.187.0.min.js",
        "beambox/visualize/vendor/three.LICENSE",
        "beambox/report/report.html",
    } <= names
    assert {name.split("/")[0] for name in names} == {"beambox", metadata.split("/")[0]}
    assert {"licenses/LICENSE", "licenses/NOTICE"} <= {name.split("/", 1)[1] for name in names if "dist-info" in name}
    assert "License-Expression: Apache-2.0 AND CC-BY-NC-SA-3.0" in text
    assert not re.findall(r"(?m)^Requires-Dist: matplotlib[^;]*$", text), "an extra, not a need"
    here = {str(path.relative_to(ROOT / "src")) for path in (ROOT / "src" / "beambox").rglob("*.yaml")}
    assert here <= names, "a recipe or a card was left out"


def test_a_recipe_with_stages_trains_by_its_name(python: Path, desk: Path, tmp_path: Path) -> None:
    place = tmp_path / "here"
    shutil.copytree(desk, place)
    shutil.copytree(place / "kitti", place / "DIR" / "simulated")
    shutil.copytree(place / "kitti", place / "DIR" / "mixed")
    shutil.copytree(place / "kitti", place / "DIR" / "more")
    cheap = "--set validation=null"
    run(python, place, [f"train pointpillars-kitti --data DIR --out made {SHORT} {cheap}"])
    assert all((place / "made" / part / "final.safetensors").is_file() for part in ("stage1", "stage2", "stage3", "."))
    run(python, place, [f"train pointpillars-kitti --data DIR --out made --resume {SHORT} {cheap}", "models made"])
