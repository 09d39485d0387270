"""Detecting in a data set and scoring what was found."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.source import FrameList
from beambox.infer.evaluate import detect_frames, parse_overlaps, score_frames, scored_frames, write_results
from beambox.structures import Detections, Frame
from oracles.tiny_training import frames


def perfect(given: list[Frame]) -> list[Detections]:
    """Find exactly what is labelled, the better the earlier the frame."""
    found = []
    for frame in given:
        assert frame.labels is not None
        score = torch.tensor([1.0 - int(frame.id) / 10])
        found.append(Detections(frame.labels.boxes, score, torch.zeros(1, dtype=torch.int64), ("Car",), frame.id))
    return found


@pytest.mark.parametrize("batch", [1, 2, 7])
def test_frames_come_in_order_whatever_the_batch(batch: int) -> None:
    source = frames(5)
    pairs = list(detect_frames(perfect, source, batch=batch, score_threshold=0.75))
    assert [frame.id for frame, _ in pairs] == source.ids
    assert [len(found) for _, found in pairs] == [1, 1, 1, 0, 0]


def test_perfect_detections_score_full_without_a_camera() -> None:
    result = score_frames(scored_frames(detect_frames(perfect, frames(5))))
    assert result.levels == ("all objects",)
    assert result["Car"].box3d[0].all_points == pytest.approx(100)
    lost = score_frames(scored_frames(detect_frames(perfect, frames(5), score_threshold=0.75)))
    assert lost["Car"].box3d[0].all_points == pytest.approx(60)


def test_unlabeled_frames_and_missing_cameras_are_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    bare = FrameList([replace(frames(1).frames[0], labels=None)])
    none = [Detections.empty(("Car",))]
    with pytest.raises(BeamboxError, match="has no labels, so detections cannot be scored"):
        scored_frames(detect_frames(lambda given: none, bare))
    with pytest.raises(BeamboxError, match="has no calibration, so KITTI result files cannot be written"):
        write_results(tmp_path, scored_frames(detect_frames(perfect, frames(1))))


def test_overlaps_are_read_from_words() -> None:
    assert parse_overlaps(["Car=0.5", "Cyclist=0.25"]) == {"Car": 0.5, "Cyclist": 0.25}
    with pytest.raises(BeamboxError, match=r'as Car=0\.5; got "Car"'):
        parse_overlaps(["Car"])
