"""Scoring during a run: KITTI's or ONCE's metric on the validation source, and the number that chooses the weights."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from PIL import Image

from beambox.data.source import FrameSource, SubsetSource
from beambox.detectors.contract import AnyModel
from beambox.infer.evaluate import detect_frames, network, score_frames, score_once, scored_frames
from beambox.metrics.kitti import KittiFrame
from beambox.metrics.kitti_result import KittiResult
from beambox.metrics.once_result import OnceResult
from beambox.train.config import ValidationSection
from beambox.train.preflight import check_validation
from beambox.visualize.bev import draw_bev

__all__ = ["Score", "Validator", "score_by", "summarize", "summarize_once"]


PICTURES = 3
"""Frames that each validation draws for TensorBoard."""
SHOWN_SCORE = 0.3
"""Detections below are not drawn."""


@dataclass(frozen=True)
class Score:
    """What a validation says."""

    value: float
    """The number that chooses the best weights, percent; NaN where no object was there to find."""
    text: str
    """One line for the console."""
    scalars: dict[str, float]
    """Numbers for the log."""
    table: dict[str, Any]
    """Everything, as ``beambox evaluate --json`` writes it."""
    curves: Mapping[str, tuple[int, Sequence[float]]] = field(default_factory=dict)
    """By class: number of objects, and the interpolated precision at recalls from 0 to 1 in even steps."""
    frames: Sequence[KittiFrame] = ()
    """What was scored, in the source's order."""


class Validator:
    """Scores a detector on the recipe's validation source."""

    def __init__(self, section: ValidationSection, source: FrameSource, dtype: torch.dtype = torch.float32) -> None:
        """Set up.

        Args:
            section: what to score by.
            source: frames to score on.
            dtype: what the network computes in, as ``beambox evaluate --precision`` would have it.
        """
        self.section, self.source, self.dtype = section, source, dtype

    def __call__(self, model: AnyModel, rank: int = 0, processes: int = 1) -> Score:
        """Score a detector; its training mode is restored.

        Args:
            model: to score.
            rank: of this process, which detects in its share of the frames.
            processes: that call this together and all get the score of all frames.
        """
        section, classes = self.section, model.config.classes
        check_validation(section, classes)
        mine = list(range(rank, len(self.source), processes))
        share = SubsetSource(self.source, mine) if processes > 1 else self.source
        frames = scored_frames(detect_frames(network(model, self.dtype), share))
        frames = gathered(frames, rank, processes)
        result = score_by(section, frames, classes)
        score = summarize_once(result, section) if isinstance(result, OnceResult) else summarize(result, section)
        precision = str(self.dtype).removeprefix("torch.")
        table = {name: {**entry, "precision": precision} for name, entry in score.table.items()}
        return replace(score, text=f"{score.text} ({precision})", table=table, frames=frames)

    def pictures(self, score: Score) -> Iterator[tuple[str, Image.Image]]:
        """Draw a few of the scored frames, the same each time, in BEV: detections beside the labels."""
        count = min(PICTURES, len(score.frames))
        for index in (len(score.frames) * k // count for k in range(count)):
            frame, scored = self.source[index], score.frames[index]
            found = scored.detections
            found = found[found.scores >= SHOWN_SCORE]
            yield frame.id, draw_bev(frame, found, scored.labels)


def gathered(frames: Sequence[KittiFrame], rank: int, processes: int) -> Sequence[KittiFrame]:
    """Return the frames of all processes in the source's order, where frame i was given to process i % processes."""
    if processes == 1:
        return frames
    shares: list[Sequence[KittiFrame]] = [[] for _ in range(processes)]
    torch.distributed.all_gather_object(shares, frames)
    return [shares[i % processes][i // processes] for i in range(sum(map(len, shares)))]


def score_by(
    section: ValidationSection, frames: Sequence[KittiFrame], classes: Sequence[str]
) -> KittiResult | OnceResult:
    """Score the classes that a detector knows by the rules of a recipe's validation: ONCE's for ONCE, else KITTI's."""
    if section.source.kind == "once":
        return score_once(frames, section.iou or None, classes)
    return score_frames(frames, classes, section.iou or None, section.level != "all")


def summarize(result: KittiResult, section: ValidationSection) -> Score:
    """Pick the recipe's number out of a result."""
    level = result.levels.index(section.level) if section.level in result.levels else 0
    scalars = {}
    for one in result.classes:
        averages = (one.box3d if section.view == "3d" else one.bev)[level]
        value = {"R40": averages.r40, "R11": averages.r11, "all": averages.all_points}[section.recalls]
        scalars[one.name] = value
    known = [value for value in scalars.values() if not math.isnan(value)]
    mean = sum(known) / len(known) if known else math.nan
    value = mean if section.choose_by == "mean" else scalars[section.choose_by]
    details = ", ".join(f"{name} {'-' if math.isnan(v) else f'{v:.2f}'}" for name, v in scalars.items())
    protocol = f"{section.view} {section.recalls} {result.levels[level]}"
    logged = {name: v for name, v in {**scalars, "mean": mean}.items() if not math.isnan(v)}
    curves = {
        one.name: (one.objects[level], averages.curve)
        for one in result.classes
        if (averages := (one.box3d if section.view == "3d" else one.bev)[level]).curve
    }
    return Score(value, f"{protocol} {details}, mean {mean:.2f}", logged, result.to_json(), curves)


def summarize_once(result: OnceResult, section: ValidationSection) -> Score:
    """Pick the recipe's number out of a result by ONCE's rules: the column ``overall`` of a class, or its mean."""
    scalars = {name: row[0] for name, row in zip(result.classes, result.ap)}
    scalars["mean"] = result.mean()[0]
    details = ", ".join(f"{name} {value:.2f}" for name, value in scalars.items())
    return Score(scalars[section.choose_by], f"ONCE AP overall {details}", scalars, result.to_json())
