"""Run a detector over a data set and score what it finds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from beambox.checks import BeamboxError
from beambox.data.source import FrameSource
from beambox.detectors.contract import AnyModel, module_of
from beambox.file_names import check_file_name
from beambox.io import write_text
from beambox.metrics import once
from beambox.metrics.box_errors import box_errors
from beambox.metrics.box_errors_result import BoxErrors
from beambox.metrics.kitti import KittiFrame, evaluate
from beambox.metrics.kitti_result import KittiResult
from beambox.metrics.once_result import OnceResult
from beambox.metrics.rounds import merge_entries, parse_rounds, score_rounds
from beambox.structures import Batch, Detections, Frame, Labels
from beambox.structures.rows import frame_of_rows

if TYPE_CHECKING:
    import pandas

__all__ = [
    "Evaluation",
    "check_classes",
    "detect_frames",
    "evaluate_frames",
    "merged_classes",
    "network",
    "parse_overlaps",
    "score_frames",
    "score_once",
    "scored_frames",
    "write_result",
    "write_results",
]

Detect = Callable[[Sequence[Frame]], list[Detections]]
"""Frames to their detections, best first, on the CPU; ``Detector.detect`` is one, :func:`network` makes one."""


def network(model: AnyModel, dtype: torch.dtype = torch.float32) -> Detect:
    """Detect with a bare network as it stands, in training say: its mode is restored after each call.

    Args:
        model: a detector of the catalogue.
        dtype: what it computes in, under autocast where that is not float32, as :class:`Detector` does.
    """
    lower = dtype != torch.float32

    @torch.inference_mode()
    def detect(frames: Sequence[Frame]) -> list[Detections]:
        device = next(iter(model.parameters())).device
        module, was_training = module_of(model), model.training
        module.eval()
        try:
            with torch.autocast(device.type, dtype=dtype if lower else torch.bfloat16, enabled=lower):
                predictions = model(Batch.of(frames).to(device))
            found = model.decode(predictions)
        finally:
            module.train(was_training)
        return [replace(one.to("cpu"), frame_id=frame.id) for frame, one in zip(frames, found)]

    return detect


def parse_overlaps(texts: Sequence[str]) -> dict[str, float]:
    """Read overlaps, each class once, given as ``Car=0.5`` or ``Car=0.5,Cyclist=0.25``.

    Raises:
        BeamboxError: quoting what cannot be read.
    """
    rounds = parse_rounds(texts)
    if len(rounds) > 1:
        raise BeamboxError(f"one overlap is wanted for each class; {next(iter(rounds[1]))} has several")
    return rounds[0]


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


@dataclass(frozen=True)
class Evaluation:
    """Scores of one set of detections, with what they were made in."""

    rounds: tuple[KittiResult | OnceResult, ...]
    """The scores; a class that is scored at several overlaps stands in several."""
    errors: BoxErrors
    """Errors of the matched boxes."""
    precision: str
    """What the network computed in, such as ``float32``."""

    def to_json(self) -> dict[str, dict[str, Any]]:
        """Return numbers ready for ``json.dump``: an entry per class, ``NAME@IOU`` for its second overlap and on."""
        entries = merge_entries(self.rounds)
        for entry in entries.values():
            entry["precision"] = self.precision
        for name, errors in self.errors.to_json().items():
            if name in entries:
                entries[name]["errors"] = errors
        return entries

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one flat record for each number scored, as the results of the rounds do."""
        return [{**row, "precision": self.precision} for result in self.rounds for row in result.to_rows()]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the records of :meth:`to_rows` as a table (needs pandas)."""
        columns = list(self.rounds[0].to_pandas().columns) if self.rounds else []
        return frame_of_rows(self.to_rows(), [*columns, "precision"])

    def __str__(self) -> str:
        """Return the numbers as text, as :meth:`table` does."""
        return self.table()

    def table(self, name: str = "this result", published: bool = False) -> str:
        """Return the numbers as text.

        Args:
            name: of the detector.
            published: add the rows of DenNet's Table 3 (ONCE alone).
        """
        tables = [
            result.table(name, published) if isinstance(result, OnceResult) else result.table()
            for result in self.rounds
        ]
        return "\n".join([*tables, self.errors.table(), f"detected in {self.precision}\n"])


def evaluate_frames(
    frames: Sequence[KittiFrame],
    classes: Sequence[str],
    rounds: Sequence[Mapping[str, float]] = ({},),
    *,
    by_once: bool = False,
    levels: bool = True,
    precision: str = "float32",
) -> Evaluation:
    """Score frames and measure the errors of the matched boxes.

    Args:
        frames: from :func:`scored_frames`.
        classes: to score.
        rounds: overlaps that count as found, by class, where they differ from the metric's own; after the first round
            only the classes named are scored again.
        by_once: by ONCE's rules instead of KITTI's.
        levels: as for :func:`score_frames`.
        precision: what the detections were made in.

    Raises:
        BeamboxError: if an overlap is missing, out of range, or of a class that is not scored.
    """

    def score(names: Sequence[str], overlaps: Mapping[str, float]) -> KittiResult | OnceResult:
        return score_once(frames, overlaps, names) if by_once else score_frames(frames, names, overlaps, levels)

    results = score_rounds(score, classes, rounds)
    if not by_once:
        return Evaluation(results, box_errors(frames, classes), precision)
    merged = [merged_classes(frame) for frame in frames]
    names = list(dict.fromkeys(once.SUPERCLASS_OF.get(name, name) for name in classes))
    return Evaluation(results, box_errors(merged, names), precision)


def check_classes(classes: Sequence[str], rounds: Sequence[Mapping[str, float]], by_once: bool) -> None:
    """Refuse classes that have no overlap, and overlaps that fit no class, before anything is detected.

    Args:
        classes: to score.
        rounds: overlaps, as for :func:`evaluate_frames`.
        by_once: by ONCE's rules instead of KITTI's.

    Raises:
        BeamboxError: naming the class.
    """
    nothing = KittiFrame(Labels.empty(), Detections.empty())
    for number, overlaps in enumerate(rounds or ({},)):
        wanted = list(overlaps) if number else classes
        if by_once:
            score_once([nothing], overlaps, wanted)
        else:
            score_frames([nothing], wanted, overlaps, levels=False)


def merged_classes(frame: KittiFrame) -> KittiFrame:
    """Name objects and detections by ONCE's merged classes."""
    merge, labels, found = once.SUPERCLASS_OF, frame.labels, frame.detections
    named = replace(labels, names=tuple(merge.get(name, name) for name in labels.names))
    return frame._replace(
        labels=named, detections=replace(found, classes=tuple(merge.get(name, name) for name in found.classes))
    )


def write_result(folder: Path, frame: Frame | KittiFrame, detections: Detections) -> None:
    """Write a frame's KITTI result file, for other evaluators and the benchmark's server.

    Raises:
        BeamboxError: if the frame has no calibration; KITTI's boxes live in the camera's frame.
    """
    if frame.calibration is None:
        raise BeamboxError(
            f"frame {detections.frame_id} has no calibration, so KITTI result files cannot be written; "
            "keep the detections with --keep FILE, or use `beambox detect --format json`"
        )
    name = check_file_name(detections.frame_id, "names of frames")
    write_text(folder / f"{name}.txt", detections.to_kitti(frame.calibration, frame.image_size))


def write_results(folder: Path, frames: Sequence[KittiFrame]) -> None:
    """Write the result files of several frames; see :func:`write_result`."""
    for frame in frames:
        write_result(folder, frame, frame.detections)
