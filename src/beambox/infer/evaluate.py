"""Run a detector over a data set and score what it finds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from beambox.checks import BeamboxError
from beambox.data.source import FrameSource
from beambox.io import check_file_name, write_text
from beambox.metrics import once
from beambox.metrics.kitti import KittiFrame, evaluate
from beambox.metrics.kitti_result import KittiResult
from beambox.metrics.once_result import OnceResult
from beambox.structures import Batch, Detections, Frame

__all__ = [
    "detect_frames",
    "network",
    "parse_overlaps",
    "score_frames",
    "score_once",
    "scored_frames",
    "write_results",
]

Detect = Callable[[Sequence[Frame]], list[Detections]]
"""Frames to their detections, best first, on the CPU; ``Detector.detect`` is one, :func:`network` makes one."""


def network(model: Any) -> Detect:
    """Detect with a bare network as it stands, in training say: its mode is restored after each call."""

    @torch.inference_mode()
    def detect(frames: Sequence[Frame]) -> list[Detections]:
        device = next(iter(model.parameters())).device
        was_training = model.training
        model.eval()
        try:
            found = model.decode(model(Batch.of(frames).to(device)))
        finally:
            model.train(was_training)
        return [replace(one.to("cpu"), frame_id=frame.id) for frame, one in zip(frames, found)]

    return detect


def parse_overlaps(texts: Sequence[str]) -> dict[str, float]:
    """Read overlaps given as ``Car=0.5``.

    Raises:
        BeamboxError: quoting what cannot be read.
    """
    overlaps = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            overlaps[name] = float(value)
        except ValueError:
            raise BeamboxError(f'an overlap is given as CLASS=VALUE, as Car=0.5; got "{text}"') from None
    return overlaps


def detect_frames(
    detect: Detect, source: FrameSource, *, batch: int = 1, score_threshold: float = 0.0
) -> Iterator[tuple[Frame, Detections]]:
    """Detect in every frame of a source, in order.

    Args:
        detect: what detects.
        source: frames.
        batch: frames in one pass; more than one pays on a GPU.
        score_threshold: drop lower scores, beyond what the model's own post-processing drops.

    Yields:
        Each frame with its detections, best first, on the CPU.
    """
    for start in range(0, len(source), batch):
        frames = [source[i] for i in range(start, min(start + batch, len(source)))]
        for frame, found in zip(frames, detect(frames)):
            yield frame, found[found.scores >= score_threshold]


def scored_frames(found: Iterable[tuple[Frame, Detections]]) -> list[KittiFrame]:
    """Keep of frames and their detections what scoring needs: no points.

    Raises:
        BeamboxError: if a frame has no labels.
    """
    kept = []
    for frame, detections in found:
        if frame.labels is None:
            raise BeamboxError(f"frame {frame.id} has no labels, so detections cannot be scored; use `beambox detect`")
        kept.append(KittiFrame(frame.labels, detections, frame.calibration, frame.image_size or (1242, 375)))
    return kept


def score_frames(
    frames: Sequence[KittiFrame],
    classes: Sequence[str] | None = None,
    iou: Mapping[str, float] | None = None,
    levels: bool = True,
) -> KittiResult:
    """Score frames by KITTI's rules, by difficulty where all have a camera and all objects together where one lacks it.

    Args:
        frames: from :func:`scored_frames`.
        classes: to score; None takes the detector's.
        iou: overlaps that count as found, by class, where they differ from KITTI's.
        levels: False scores all objects together in any case.
    """
    graded = levels and all(
        frame.calibration is not None and (frame.labels.attributes is not None or not len(frame.labels))
        for frame in frames
    )
    return evaluate(frames, classes, min_overlap=iou, no_difficulty=not graded)


def score_once(
    frames: Sequence[KittiFrame], iou: Mapping[str, float] | None = None, known: Collection[str] | None = None
) -> OnceResult:
    """Score frames by ONCE's rules; arguments as in :func:`beambox.metrics.once.evaluate`."""
    pairs = [(frame.labels, frame.detections) for frame in frames]
    return once.evaluate(pairs, min_overlap=iou, known=known)


def write_results(folder: Path, frames: Sequence[KittiFrame]) -> None:
    """Write one KITTI result file a frame, for other evaluators and the benchmark's server.

    Raises:
        BeamboxError: if a frame has no calibration; KITTI's boxes live in the camera's frame.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        if frame.calibration is None:
            raise BeamboxError(
                f"frame {frame.detections.frame_id} has no calibration, so KITTI result files cannot be written; "
                "use `beambox detect --format json`"
            )
        text = frame.detections.to_kitti(frame.calibration, frame.image_size)
        name = check_file_name(frame.detections.frame_id, "a result file")
        write_text(folder / f"{name}.txt", text)
