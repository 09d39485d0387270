"""Inputs that are not there are refused before torch, which takes seconds, is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import beambox

COMMANDS = [
    "detect MISSING",
    "detect HERE --model MISSING",
    "show MISSING",
    "view MISSING",
    "stream MISSING --model pointpillars-sim --out out.mcap",
    "track MISSING --model pointpillars-sim",
    "track --results MISSING",
    "explain dennet-kitti MISSING",
    "doctor MISSING",
    "models MISSING",
    "simulate out --compare MISSING",
    "train MISSING",
    "train pointpillars-small --data MISSING",
    "evaluate pointpillars-sim --data MISSING",
    "evaluate MISSING --data HERE",
    "report pointpillars-sim --data MISSING",
    "data check MISSING",
    "data anchors MISSING",
    "data voxels MISSING",
    "data convert MISSING --from csv --to table --out out",
    "bench MISSING",
    "bench pointpillars-sim MISSING",
    "submit MISSING",
    "export MISSING --out out.onnx",
    "import-openpcdet MISSING --model second --out out.safetensors",
    "score kitti --labels MISSING --results HERE",
    "score once --annotations MISSING",
    "score tracking --labels MISSING --results HERE --calib HERE",
]
RUN = """
import sys
from beambox.cli.main import main

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            raise RuntimeError("torch is imported")

sys.meta_path.insert(0, NoTorch())
for line in sys.argv[1:]:
    try:
        main(line.split())
        print(line, "went on", sep="|")
    except SystemExit as left:
        print(line, left.code, sep="|")
    except RuntimeError as heavy:
        print(line, heavy, sep="|")
    sys.stdout.flush()
"""


def test_what_is_not_there_is_refused_before_torch_is_imported(tmp_path: Path) -> None:
    here = tmp_path / "scan.bin"
    here.write_bytes(bytes(16))
    lines = [one.replace("MISSING", "no-such-thing").replace("HERE", str(here)) for one in COMMANDS]
    env = {**os.environ, "PYTHONPATH": str(Path(beambox.__file__).parents[1])}
    run = [sys.executable, "-c", RUN, *lines]
    done = subprocess.run(run, capture_output=True, text=True, cwd=tmp_path, check=True, env=env)
    heavy = [line for line in done.stdout.splitlines() if not line.endswith("|2")]
    assert heavy == [], "\n".join(heavy)
    assert done.stderr.count("no-such-thing") == len(COMMANDS), done.stderr
    assert list(tmp_path.iterdir()) == [here], "nothing is written"
