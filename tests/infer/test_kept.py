"""Detections kept while they are made: nothing is detected twice, nothing is lost, nothing is mixed up."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.infer.evaluate import detect_frames, score_frames, scored_frames
from beambox.infer.kept import KeptDetections
from beambox.structures import Detections, Frame
from oracles.tiny_training import frames

MADE_BY = {"weights": "abc", "precision": "float32"}


class Counting:
    """Finds every object, a third of a metre off, and counts its frames."""

    def __init__(self, stop_at: int = 1000) -> None:
        self.frames: list[str] = []
        self.stop_at = stop_at

    def __call__(self, given: Sequence[Frame]) -> list[Detections]:
        found = []
        for frame in given:
            if len(self.frames) == self.stop_at:
                raise KeyboardInterrupt
            self.frames.append(frame.id)
            assert frame.labels is not None
            boxes = frame.labels.boxes + 1 / 3
            found.append(Detections(boxes, torch.full((len(boxes),), 1 / 7), torch.zeros(1).long(), ("Car",), frame.id))
        return found


def kept(path: Path, **made_by: str) -> KeptDetections:
    return KeptDetections(path, {**MADE_BY, **made_by}, ("Car",))


def test_an_interrupted_evaluation_goes_on_where_it_stopped_and_scores_the_same(tmp_path: Path) -> None:
    source, path = frames(5), tmp_path / "new" / "kept.jsonl"
    with pytest.raises(KeyboardInterrupt):
        list(kept(path).detect(Counting(stop_at=3), source))
    with path.open("ab") as file:
        file.write(b'{"frame": "000003", "boxes": [[1')  # the process was killed within a line
    rest = Counting()
    found = list(kept(path).detect(rest, source, batch=2))
    assert rest.frames == ["000003", "000004"]
    direct = list(detect_frames(Counting(), source))
    for (frame, one), (_, other) in zip(found, direct, strict=True):
        assert frame.id == one.frame_id
        assert torch.equal(one.boxes, other.boxes) and torch.equal(one.scores, other.scores)
    again = Counting()
    scored = score_frames(scored_frames(kept(path).detect(again, source)), ["Car"], {"Car": 0.3})
    assert again.frames == []
    assert scored.to_json() == score_frames(scored_frames(direct), ["Car"], {"Car": 0.3}).to_json()
    assert len(path.read_text().splitlines()) == 6


def test_detections_made_otherwise_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "kept.jsonl"
    list(kept(path).detect(Counting(), frames(1)))
    before = path.read_bytes()
    with pytest.raises(BeamboxError, match="made otherwise: precision was float32, is bfloat16; give another name"):
        kept(path, precision="bfloat16")
    with pytest.raises(BeamboxError, match="made otherwise: classes was"):
        KeptDetections(path, MADE_BY, ("Car", "Van"))
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no end of line", "is not a file of kept detections"),
        (b"text\n", "line 1: is not valid JSON|line 1 is not valid JSON"),
        (b"[1]\n", "line 1: expected a JSON object"),
        (b"\xff\xfe\n", "line 1: expected a JSON object"),
        (b'{"format": "other"}\n', "is not a file of kept detections"),
    ],
)
def test_other_files_are_refused_and_left_alone(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "kept.jsonl"
    path.write_bytes(content)
    with pytest.raises(BeamboxError, match=message):
        kept(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "damage",
    [{"boxes": [[1, 2]]}, {"class_ids": [9]}, {"scores": []}, {"boxes": "x"}, {"boxes": [[1e999] * 7]}, {"frame": 7}],
)
def test_damaged_lines_are_named(damage: dict[str, object], tmp_path: Path) -> None:
    path = tmp_path / "kept.jsonl"
    list(kept(path).detect(Counting(), frames(1)))
    head, line = path.read_text().splitlines()
    path.write_text(f"{head}\n{json.dumps({**json.loads(line), **damage})}\n")
    with pytest.raises(BeamboxError, match="line 2"):
        kept(path)
