"""The page about data of one's own runs as printed, and evaluation takes every layout."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import pytest
import torch

from beambox.data.once import write_once_sequence, write_once_split
from beambox.structures import Frame, Labels
from oracles.command_line import beambox
from oracles.own_data import scene, write_pandaset
from oracles.paths import ROOT, data_dir
from oracles.tiny_detector import tiny_weights

PAGE = (ROOT / "docs" / "custom_data.md").read_text(encoding="utf-8")


def marked(kind: str) -> list[str]:
    """Return the code blocks behind a mark such as ``<!-- run -->``."""
    return re.findall(rf"<!-- {kind} -->\n```\w+\n(.*?)```", PAGE, flags=re.DOTALL)


def run_block(block: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a block's lines in the current folder: beambox commands, printf into a file, sed of a file."""
    output = ""
    for line in block.splitlines():
        words = line.split()
        if words[0] == "beambox":
            ran = beambox(capsys, *words[1:])
            assert ran.status == 0, ran.err
            output += ran.out
        elif words[0] == "sed":
            edit = re.fullmatch(r'sed -i "s/(.*)/(.*)/" (\S+)', line)
            assert edit is not None
            path = Path(edit[3])
            text = path.read_text(encoding="utf-8")
            assert edit[1] in text
            path.write_text(text.replace(edit[1], edit[2]), encoding="utf-8")
        else:
            assert words[:2] == ["printf", r"'%s\n'"] and words[-2] == ">"
            Path(words[-1]).write_text("".join(f"{word}\n" for word in words[2:-2]), encoding="utf-8")
    return output


def test_the_page_runs_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("velodyne", "boxes"):
        shutil.copytree(data_dir("pandaset_002", folder), tmp_path / folder)
    for place in [tmp_path, *tmp_path.rglob("*")]:
        os.chmod(place, 0o755)
    monkeypatch.chdir(tmp_path)
    (name,) = re.findall(r"<!-- file: (\S+) -->", PAGE)
    Path(name).write_text(marked("file: data.yaml")[0], encoding="utf-8")
    output = "".join(run_block(block, capsys) for block in marked("run"))
    printed = re.search(r"```\n(7 frames.*?)```", PAGE, flags=re.DOTALL)
    assert printed is not None and printed[1] in output
    assert re.search(r"\{name: Car, size: \[4\.\d\d, 1\.\d\d, 1\.\d\d\], bottom_z: -[12]\.\d\d", output)
    weights = tiny_weights(tmp_path)
    output = run_block(f"beambox evaluate {weights} --data data.yaml --split val --json ap.json", capsys)
    assert "2 frames" in output and "every object counts" in output
    scores = json.loads(Path("ap.json").read_text(encoding="utf-8"))
    assert list(scores["Car"]) == ["iou", "3d", "bev", "precision", "errors"] and len(scores["Car"]["3d"]["all"]) == 1


def test_evaluate_scores_once_by_its_own_rules(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = []
    for seed in range(2):
        points, boxes = scene(seed)
        frames.append(
            Frame(torch.from_numpy(points), f"{seed}00", Labels(torch.from_numpy(boxes), ("Car",) * len(boxes)))
        )
    write_once_sequence(tmp_path, "000001", frames)
    write_once_split(tmp_path, "val", ["000001"])
    words = ["evaluate", tiny_weights(tmp_path), "--data", tmp_path, "--json", tmp_path / "ap.json"]
    ran = beambox(capsys, *words, "--published", "--iou", "Vehicle=0.7,Vehicle=0.3")
    assert ran.status == 0, ran.err
    assert ran.out.count("ONCE AP in percent, 2 frames") == 2 and "Vehicle > 0.30" in ran.out
    assert "not measured here" in ran.out
    scores = json.loads((tmp_path / "ap.json").read_text(encoding="utf-8"))
    assert list(scores) == ["Vehicle", "Pedestrian", "Cyclist", "mean", "Vehicle@0.3"]
    assert [scores[name]["iou"] for name in ("Vehicle", "Vehicle@0.3")] == [0.7, 0.3]


def test_training_takes_described_data(tmp_path: Path) -> None:
    from beambox.train.config import SourceSection
    from beambox.train.sources import open_source

    source = open_source(SourceSection(kind="custom", split="all"), write_pandaset(tmp_path))
    assert list(source.ids) == ["00", "01", "02"]
