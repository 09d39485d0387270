"""Propose anchors for a data set: sizes and heights of its own objects instead of KITTI's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from beambox.structures import Labels

__all__ = ["AnchorProposal", "proposals_text", "propose_anchors"]

LARGE = 1.2
"""Objects longer than this many metres get the thresholds of vehicles."""


@dataclass(frozen=True)
class AnchorProposal:
    """An anchor for one class."""

    name: str
    boxes: int
    """Number of labels it comes from."""
    size: tuple[float, float, float]
    """Mean length, width and height, metres."""
    bottom_z: float
    """Median height of the lower faces, metres."""
    matched_threshold: float
    """Overlap from which an anchor is positive."""
    unmatched_threshold: float
    """Overlap below which an anchor is negative."""
    covered: float
    """Share of the boxes whose IoU with the anchor at the same place and heading is at least ``matched_threshold``."""


def propose_anchors(labels: Iterable[Labels]) -> list[AnchorProposal]:
    """Propose one anchor a class.

    Args:
        labels: of all frames, in the frame that the network will see.

    Returns:
        The most frequent class first.
    """
    sizes: dict[str, list[np.ndarray]] = {}
    for one in labels:
        for name, box in zip(one.names, one.boxes.double().numpy()):
            sizes.setdefault(name, []).append(box)
    ordered = sorted(sizes.items(), key=lambda item: -len(item[1]))
    return [_proposal(name, np.stack(boxes)) for name, boxes in ordered]


def _proposal(name: str, boxes: np.ndarray) -> AnchorProposal:
    length, width, height = (float(value) for value in boxes[:, 3:6].mean(axis=0).round(2))
    matched_threshold, unmatched_threshold = (0.6, 0.45) if length > LARGE and width > LARGE else (0.5, 0.35)
    mean = np.array([length, width, height])
    bottoms = boxes[:, 2] - boxes[:, 5] / 2
    shared = np.minimum(boxes[:, 3:5], mean[:2]).prod(axis=1)  # in BEV, as anchors are matched
    union = boxes[:, 3:5].prod(axis=1) + mean[:2].prod() - shared
    return AnchorProposal(
        name=name,
        boxes=len(boxes),
        size=(length, width, height),
        bottom_z=float(np.median(bottoms).round(2)),
        matched_threshold=matched_threshold,
        unmatched_threshold=unmatched_threshold,
        covered=float((shared / union >= matched_threshold).mean()),
    )


def proposals_text(proposals: Iterable[AnchorProposal]) -> str:
    """Write proposals as the lines of a recipe."""
    proposals = list(proposals)
    lines = ["detector:", "  options:", "    anchors:"]
    for one in proposals:
        length, width, height = one.size
        lines.append(
            f"      - {{name: {one.name}, size: [{length:.2f}, {width:.2f}, {height:.2f}], "
            f"bottom_z: {one.bottom_z:.2f}, matched_threshold: {one.matched_threshold:.2f}, "
            f"unmatched_threshold: {one.unmatched_threshold:.2f}}}"
            f"  # {one.boxes} boxes, {100 * one.covered:.0f} % fit"
        )
    poor = [one.name for one in proposals if one.covered < 0.8 and one.boxes >= 20]
    lines += [f"# {name}: sizes vary much; split the class or lower `matched_threshold`" for name in poor]
    rare = [one.name for one in proposals if one.boxes < 20]
    lines += [f"# {name}: few boxes; take a size from experience" for name in rare]
    return "\n".join(lines) + "\n"
