"""The pages "Add a detector" and "Add a reader", followed: their files become installed packages, and are used."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch

import beambox
from beambox.checks import BeamboxError
from beambox.detectors.catalog import CATALOG
from beambox.infer.inputs import find_sweeps
from oracles import pages
from oracles.paths import ROOT
from oracles.tiny_training import OPTIONS, tiny_kitti

Install = Callable[[str], Path]


def words(changes: dict[str, object]) -> list[str]:
    """Return changes of a recipe as `--set` takes them."""
    return [f"{key}={json.dumps(value)}" for key, value in changes.items()]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Give a function that installs the files of a page of docs/, as pip would, and returns their folder."""
    before = set(sys.modules)
    names = set(CATALOG)

    def install_page(page: str) -> Path:
        folder = tmp_path / "package"
        folder.mkdir()
        for block in pages.blocks(ROOT / "docs" / page):
            if block.mark.startswith("file: "):
                (folder / block.mark.removeprefix("file: ")).write_text(block.text, encoding="utf-8")
        project = (folder / "pyproject.toml").read_text(encoding="utf-8")
        (name,) = re.findall(r'(?m)^name = "(.*)"$', project)
        ((group, entry),) = re.findall(r'(?m)^\[project\.entry-points\."(.*)"\]\n(.*)$', project)
        info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{entry.replace(chr(34), '')}\n")
        monkeypatch.syspath_prepend(str(folder))
        return folder

    yield install_page
    for module in set(sys.modules) - before:
        if module in ("heightmap", "xyz_for_beambox"):
            del sys.modules[module]
    for name in set(CATALOG) - names:
        del CATALOG[name]


def test_the_detector_of_the_page_trains_scores_and_detects(install: Install, tmp_path: Path) -> None:
    folder = install("add_detector.md")
    data = tiny_kitti(tmp_path / "kitti")
    grid = {"detector.options.grid": OPTIONS["grid"], "window": None, "workers": 0, "precision": "float32"}
    short = {"optim.iterations": 100, "optim.batch": 2, "optim.lr": 0.01, "validation": None, "augment": None}
    run = tmp_path / "run"
    beambox.train(folder / "heightmap.yaml", data, run, overrides=words({**grid, **short}))
    detector = beambox.load(run, view="full")
    assert type(detector.model).__name__ == "HeightMap"
    scores = beambox.evaluate(run, data, split="train", iou=[{"Car": 0.3}], levels=False)
    assert scores.to_json()["Car"]["bev"]["all"][0] > 50, "it learned the five cars it saw"
    found = detector(data / "training" / "velodyne" / "000000.bin")
    assert set(found.names) <= {"Car"} and found.boxes.shape[1] == 7


def test_weights_of_an_absent_package_say_so(install: Install, tmp_path: Path) -> None:
    folder = install("add_detector.md")
    run = tmp_path / "run"
    options = {"detector.options.grid": OPTIONS["grid"], "window": None, "workers": 0, "validation": None}
    beambox.train(
        folder / "heightmap.yaml",
        tiny_kitti(tmp_path / "kitti"),
        run,
        overrides=words({**options, "optim.iterations": 1}),
    )
    CATALOG.pop("heightmap")
    sys.path.remove(str(folder))
    with pytest.raises(BeamboxError, match='no detector is called "heightmap"'):
        beambox.load(run)


def test_the_reader_of_the_page_reads(install: Install, tmp_path: Path) -> None:
    sweep = tmp_path / "a.xyz"
    cloud = np.array([[10, 2, -1, 255], [20, -3, 0.5, 51], [np.nan, 0, 0, 9]], dtype=np.float32)
    np.savetxt(sweep, cloud)
    with pytest.raises(BeamboxError, match=r'has the ending "\.xyz", which no reader knows'):
        beambox.read_frame(sweep)
    install("add_reader.md")
    frame = beambox.read_frame(sweep)
    torch.testing.assert_close(frame.points, torch.tensor([[10, 2, -1, 1], [20, -3, 0.5, 0.2]]))
    assert [one.name for one in find_sweeps([str(tmp_path)])] == ["a"], "folders show it too"
    assert beambox.read_frame(sweep, intensity_scale=1).points[0, 3] == 255


@pytest.mark.parametrize(
    ("text", "says"), [("1 2 3\n", "four numbers per line were expected, got 3"), ("a b c d\n", "not a readable .xyz")]
)
def test_what_a_reader_raises_is_one_line_that_names_the_file(
    install: Install, tmp_path: Path, text: str, says: str
) -> None:
    install("add_reader.md")
    (tmp_path / "b.xyz").write_text(text)
    with pytest.raises(BeamboxError, match=rf"b\.xyz.*{says}"):
        beambox.read_frame(tmp_path / "b.xyz")


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ("xyz = json:loads", "b.xyz is not a readable"),
        ("xyz = pathlib:Path", "must return a beambox.data.formats.columns.Columns"),
        ("xyz = no_such_module:read", 'entry point "xyz" .* cannot be loaded'),
    ],
)
def test_a_reader_that_is_none_is_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entry: str, says: str
) -> None:
    info = tmp_path / "wrong-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: wrong\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[beambox.readers]\n{entry}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert metadata.entry_points(group="beambox.readers")
    (tmp_path / "b.xyz").write_text("1 2 3 4\n")
    with pytest.raises(BeamboxError, match=says):
        beambox.read_frame(tmp_path / "b.xyz")
