"""From weights to a detector that trains: a fresh one, or one that takes over what fits of other weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build, options_since, tensors_since
from beambox.detectors.contract import AnyModel
from beambox.detectors.weights import WeightFile, read_weights, warn_of_licence
from beambox.train.config import DetectorSection
from beambox.zoo import find_weights

__all__ = ["build_detector", "take_over"]

SHOWN = 6


def build_detector(section: DetectorSection, seed: int) -> tuple[AnyModel, list[str]]:
    """Build a recipe's detector, from random weights or from those that it starts from.

    Args:
        section: of the recipe.
        seed: of the random weights.

    Returns:
        The detector, and lines that say what came from where.

    Raises:
        BeamboxError: if there are no such weights, they are another detector's, or nothing of them fits.
    """
    if section.start_from is None:
        return _fresh(section.name, section.options, seed), []
    stored = read_weights(find_weights(section.start_from))
    if stored.detector != section.name:
        raise BeamboxError(
            f"detector.start_from: {section.start_from} holds a {stored.detector}, the recipe trains a {section.name}"
        )
    warn_of_licence(Path(section.start_from).stem, str(stored.card.get("licence", "")))
    base, changes = (options_since(section.name, options) for options in (stored.config, section.options))
    detector = _fresh(section.name, _over(base, changes), seed)
    return detector, take_over(detector, stored, section.start_from)


def _fresh(name: str, options: dict[str, Any], seed: int) -> AnyModel:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build(name, options)


def _over(base: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Lay a recipe's options over those of the weights, at any depth."""
    joined = dict(base)
    for key, value in options.items():
        under = joined.get(key)
        joined[key] = _over(under, value) if isinstance(under, dict) and isinstance(value, dict) else value
    return joined


@torch.no_grad()
def take_over(detector: AnyModel, stored: WeightFile, where: str) -> list[str]:
    """Copy all tensors that fit by name and shape; returns lines that say so and name what did not.

    Raises:
        BeamboxError: if none fits.
    """
    own, theirs = detector.state_dict(), tensors_since(detector, stored.tensors)
    fitting = [name for name in own if name in theirs and theirs[name].shape == own[name].shape]
    weights = {name for name, _ in detector.named_parameters()}
    if not weights & set(fitting):
        raise BeamboxError(
            f"detector.start_from: no tensor of {where} fits the recipe's detector, whose widths or cells differ; "
            "leave these options out to take those of the weights, or start without them"
        )
    for name in fitting:
        own[name].copy_(theirs[name])
    lines = [f"started from {where}: {len(fitting)} of {len(own)} tensors"]
    fresh = [name for name in own if name not in fitting]
    if fresh:
        replaced = [
            f"{name} {tuple(theirs[name].shape)} -> {tuple(own[name].shape)}"
            if name in theirs
            else f"{name} (not in the weights)"
            for name in fresh
        ]
        more = f" and {len(replaced) - SHOWN} more" if len(replaced) > SHOWN else ""
        lines.append(f"  begun anew, as their shapes differ: {', '.join(replaced[:SHOWN])}{more}")
    return lines
