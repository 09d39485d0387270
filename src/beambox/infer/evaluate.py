"""Run a detector over a data set and score what it finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.source import FrameSource
from beambox.detectors.weights import load_weights
from beambox.metrics.kitti import KittiFrame, evaluate
from beambox.metrics.kitti_result import KittiResult
from beambox.structures import Batch, Detections, Frame

__all__ = ["detect_frames", "detector_for", "parse_overlaps", "score_frames", "scored_frames", "write_results"]

Progress = Callable[[int], None]


def detector_for(name: str, device: str = "auto") -> Any:
    """Load a bare detector (three calls, no reading of files) from a weight file, the folder of a run, or by name.

    Args:
        name: path of a weight file, or folder of a run, whose best weights are taken, else its final ones.
        device: ``auto``, ``cpu`` or ``cuda``.
    """
    path = Path(name)
    if path.is_dir():
        held = [path / file for file in ("best.safetensors", "final.safetensors") if (path / file).is_file()]
        if not held:
            raise MissingFileError(
                f"{path} holds no weights: expected best.safetensors or final.safetensors, which `beambox train` "
                "writes at its first validation and at its end"
            )
        path = held[0]
    chosen = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    return load_weights(path, chosen)


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


@torch.inference_mode()
def detect_frames(
    model: Any, source: FrameSource, *, batch: int = 1, score_threshold: float = 0.0
) -> Iterator[tuple[Frame, Detections]]:
    """Detect in every frame of a source, in order.

    Args:
        model: a detector; its training mode is restored in the end.
        source: frames.
        batch: frames in one pass; more than one pays on a GPU.
        score_threshold: drop lower scores, beyond what the model's own post-processing drops.

    Yields:
        Each frame with its detections, best first, on the CPU.
    """
    device = next(iter(model.parameters())).device
    was_training = model.training
    model.eval()
    try:
        for start in range(0, len(source), batch):
            frames = [source[i] for i in range(start, min(start + batch, len(source)))]
            found = model.decode(model(Batch.of(frames).to(device)))
            for frame, one in zip(frames, found):
                kept = one.to("cpu")
                yield frame, replace(kept[kept.scores >= score_threshold], frame_id=frame.id)
    finally:
        model.train(was_training)


def scored_frames(
    model: Any,
    source: FrameSource,
    *,
    batch: int = 1,
    score_threshold: float = 0.0,
    progress: Progress | None = None,
) -> list[KittiFrame]:
    """Detect in a labelled source and keep what scoring needs: no points.

    Args:
        model: a detector.
        source: frames with labels.
        batch: frames in one pass.
        score_threshold: as for :func:`detect_frames`.
        progress: told the number of frames done, after each.

    Raises:
        BeamboxError: if a frame has no labels.
    """
    kept = []
    for frame, found in detect_frames(model, source, batch=batch, score_threshold=score_threshold):
        if frame.labels is None:
            raise BeamboxError(f"frame {frame.id} has no labels, so detections cannot be scored; use `beambox detect`")
        size = frame.image_size or (1242, 375)
        kept.append(KittiFrame(frame.labels, found, frame.calibration, size))
        if progress is not None:
            progress(len(kept))
    return kept


def score_frames(
    frames: Sequence[KittiFrame], classes: Sequence[str] | None = None, iou: Mapping[str, float] | None = None
) -> KittiResult:
    """Score frames by KITTI's rules, by difficulty where all have a camera and all objects together where one lacks it.

    Args:
        frames: from :func:`scored_frames`.
        classes: to score; None takes the detector's.
        iou: overlaps that count as found, by class, where they differ from KITTI's.
    """
    graded = all(
        frame.calibration is not None and (frame.labels.attributes is not None or not len(frame.labels))
        for frame in frames
    )
    return evaluate(frames, classes, min_overlap=iou, no_difficulty=not graded)


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
        path = folder / f"{frame.detections.frame_id}.txt"
        temporary = path.with_name(f".{path.name}.part")
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
