"""Folders of one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.folder import FolderSource, format_boxes, parse_boxes
from beambox.data.source import FrameSource
from beambox.structures import Labels
from oracles.paths import data_dir

CLOUD = np.random.default_rng(0).random((30, 4)).astype(np.float32)


def own(root: Path) -> Path:
    (root / "points").mkdir(parents=True)
    (root / "labels").mkdir()
    (root / "ImageSets").mkdir()
    np.save(root / "points" / "b.npy", CLOUD)
    CLOUD.tofile(root / "points" / "a.bin")
    (root / "points" / "notes.md").write_text("not a sweep")
    (root / "labels" / "a.txt").write_text("# class x y z l w h yaw\nForklift 1 2 3 4 5 6 0.5 and more\n\n")
    (root / "ImageSets" / "train.txt").write_text("b\n")
    return root


def test_a_folder_of_ones_own(tmp_path: Path) -> None:
    source = FolderSource(own(tmp_path))
    assert isinstance(source, FrameSource)
    assert list(source.ids) == ["a", "b"] and len(source) == 2
    labels = source[0].labels
    assert labels is not None and labels.names == ("Forklift",) and labels.boxes.tolist() == [[1, 2, 3, 4, 5, 6, 0.5]]
    assert source[1].labels is None and torch.equal(source[1].points, torch.from_numpy(CLOUD))
    assert list(FolderSource(tmp_path, "train").ids) == ["b"]


def test_bad_folders_of_ones_own_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"points is not a folder; expected one of sweeps \(.bin .npy"):
        FolderSource(tmp_path)
    own(tmp_path)
    with pytest.raises(MissingFileError, match=r'no split "al" \(did you mean "all"\?\)'):
        FolderSource(tmp_path, "al")
    (tmp_path / "ImageSets" / "train.txt").write_text("c")
    with pytest.raises(MissingFileError, match=r'split "train" names c, but .*points holds no such sweep'):
        FolderSource(tmp_path, "train")
    CLOUD.tofile(tmp_path / "points" / "b.bin")
    with pytest.raises(BeamboxError, match="holds two sweeps called b; names must differ"):
        FolderSource(tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 1 2 3", "a.txt, line 2: expected `class x y z l w h yaw`, got 4 columns"),
        ("Car 1 2 3 4 x 6 0", "a.txt, line 2: expected a class and 7 numbers, got 'Car 1 2 3 4 x 6 0'"),
        ("Car 1 2 nan 4 5 6 0", "a.txt, line 2: expected a class and 7 numbers"),
        ("Car 1 2 3 4 -5 6 0", "a.txt, line 2: l, w and h must be at least 0, got 4 -5 6"),
    ],
)
def test_bad_box_lines_are_named(line: str, message: str) -> None:
    with pytest.raises(BeamboxError) as caught:
        parse_boxes(f"# boxes\n{line}\n", "a.txt")
    assert message in str(caught.value)


@given(st.lists(st.tuples(*[st.floats(-80, 80)] * 3, *[st.floats(0.1, 20)] * 3, st.floats(-3.1, 3.1)), max_size=5))
def test_boxes_come_back_from_their_text(rows: list) -> None:
    labels = Labels(torch.tensor(rows).reshape(-1, 7), ("Car",) * len(rows))
    again = parse_boxes(format_boxes(labels))
    assert again.names == labels.names
    torch.testing.assert_close(again.boxes, labels.boxes, atol=1e-4, rtol=0)


def test_pandaset_is_a_folder_of_ones_own() -> None:
    source = FolderSource(data_dir("pandaset_002"), points="velodyne", labels="boxes")
    assert len(source) == 7
    labels = source[0].labels
    assert labels is not None and labels.names.count("Car") > 20
    assert float(labels.of_classes(["Car"]).boxes[:, 3].median()) == pytest.approx(4.6, abs=0.5)
