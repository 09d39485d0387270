"""Result files for the test server: every fault is named, good files are packed."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.submission import KITTI_TEST_FRAMES, check_results, write_submission
from beambox.geometry import Calibration
from beambox.structures import Detections

LINE = "Car -1 -1 0.10 100.00 150.00 200.00 220.00 1.50 1.60 3.90 2.00 1.60 20.00 0.20 0.9000"
FRAMES = ("000000", "000001")


def folder(path: Path, *texts: str) -> Path:
    path.mkdir(exist_ok=True)
    for name, text in zip(FRAMES, texts):
        (path / f"{name}.txt").write_text(text)
    return path


def swap(column: int, word: str) -> str:
    words = LINE.split()
    words[column - 1] = word
    return " ".join(words)


def test_good_results_are_packed(tmp_path: Path) -> None:
    results = folder(tmp_path / "results", LINE + "\n" + swap(1, "Cyclist") + "\n", "")
    first = write_submission(results, tmp_path / "a" / "first.zip", FRAMES).read_bytes()
    assert write_submission(results, tmp_path / "second.zip", FRAMES).read_bytes() == first
    with zipfile.ZipFile(tmp_path / "second.zip") as archive:
        assert archive.namelist() == ["data/000000.txt", "data/000001.txt"]
        assert archive.read("data/000000.txt").decode() == (results / "000000.txt").read_text()
    assert [path.name for path in tmp_path.glob("*.part")] == []


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (LINE.rsplit(" ", 1)[0], "the score (column 16) is missing"),
        (LINE + " 1", "expected 16 columns, got 17"),
        (swap(1, "Cars"), 'unknown class "Cars" (did you mean "Car"?)'),
        (swap(12, "x"), 'column 12 must be a number, got "x"'),
        (swap(16, "nan"), "column 16 must be finite, got nan"),
        (swap(12, "-inf"), "column 12 must be finite, got -inf"),
        (swap(7, "50"), "the image box must have left <= right and top <= bottom, got 100.00 150.00 50 220.00"),
        (swap(10, "0"), "height, width and length must be positive, got 1.50 0 3.90"),
        (swap(4, "-10"), "alpha is -10 (unknown), so the server would score no orientation"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, fault: str) -> None:
    results = folder(tmp_path / "results", LINE + "\n" + line, LINE)
    faults = list(check_results(results, FRAMES))
    assert len(faults) == 1 and faults[0].startswith(f"000000.txt, line 2: {fault}")
    with pytest.raises(BeamboxError, match=r"cannot be submitted, 1 faults:\n  000000\.txt, line 2: "):
        write_submission(results, tmp_path / "out.zip", FRAMES)
    assert not (tmp_path / "out.zip").exists()


def test_alpha_may_be_left_out_on_purpose(tmp_path: Path) -> None:
    results = folder(tmp_path / "results", swap(4, "-10"), "")
    assert list(check_results(results, FRAMES, need_alpha=False)) == []


def test_missing_and_unknown_frames_are_named(tmp_path: Path) -> None:
    results = folder(tmp_path / "results", LINE)
    (results / "999999.txt").write_text("")
    assert list(check_results(results, FRAMES)) == [
        "1 of 2 frames have no file, the first is 000001.txt; write an empty one where nothing was found",
        "999999.txt names no frame of the split (expected 000000 to 000001)",
    ]
    assert next(check_results(results)).startswith("7517 of 7518 frames have no file, the first is 000001.txt")
    assert KITTI_TEST_FRAMES[-1] == "007517"


def test_empty_folders_and_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(
        MissingFileError, match=r"is not a folder; expected one that holds result files such as 000000\.txt"
    ):
        list(check_results(tmp_path / "none"))
    assert "holds no result file" in next(check_results(tmp_path))
    assert list(check_results(folder(tmp_path / "results", "", "\n"), FRAMES)) == ["no file holds any detection"]


def test_many_faults_are_cut_short(tmp_path: Path) -> None:
    results = folder(tmp_path / "results", "Car 1\n" * 30, LINE)
    with pytest.raises(BeamboxError, match=r"30 faults:\n(.*\n){10}  and 20 more$"):
        write_submission(results, tmp_path / "out.zip", FRAMES)


def test_what_detections_write_can_be_submitted(tmp_path: Path) -> None:
    calibration = Calibration(
        torch.tensor([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
        torch.eye(3),
        torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
    )
    boxes = torch.tensor([[20.0, 1, -1, 4, 1.8, 1.5, 0.3], [9.0, -8, -1, 4, 1.8, 1.5, -3]])
    found = Detections(boxes, torch.tensor([0.9, 0.4]), torch.zeros(2, dtype=torch.int64), ("Car",))
    assert list(check_results(folder(tmp_path, found.to_kitti(calibration, (1242, 375)), ""), FRAMES)) == []
