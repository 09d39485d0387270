"""What fields and tensors were called before: old recipes, weights and checkpoints go on loading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from beambox.checks import BeamboxError

__all__ = ["FIELDS", "current_fields", "current_names"]

FIELDS = {
    "max_pillars": "max_voxels",  # PointPillars
    "pillar_channels": "voxel_channels",  # PointPillars
    "columns": "num_point_features",
    "centred_anchors": "centered_anchors",
    "normalisation": "normalization",  # DenNet
    "lattice": "grid_size",  # Voxel R-CNN and DenNet
    "swapped": "swap_cls_loc_weights",  # KASSD
    "anchors.bottom": "bottom_z",
    "anchors.matched": "matched_threshold",
    "anchors.unmatched": "unmatched_threshold",
    "pooling.reach": "query_range",
    "pooling.samples": "max_samples",
    "sampling.per_sample": "rois_per_frame",
    "sampling.positive_share": "fg_fraction",
    "sampling.positive_iou": "fg_iou",
    "sampling.easy_iou": "bg_iou_low",
    "sampling.hard_share": "hard_bg_fraction",
    "sampling.score_low": "cls_bg_iou",
    "sampling.score_high": "cls_fg_iou",
}
"""Former name of a configuration's field, with the sections it lies in (version 0.1.0) -> its name now."""

PARTS = ("", "model.", "ema.", "optim.")
"""What stands before a tensor's name: nothing in weights, the rest in checkpoints."""

T = TypeVar("T")


def current_fields(options: Mapping[str, Any], own: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Return options, at any depth, under the names that configurations have now.

    Args:
        options: as written in a recipe, a weight file or a checkpoint.
        own: a configuration of the same detector as plain values: what is a field of it is nothing's former name.
        section: where the options lie, ending in a dot; empty at the top.

    Raises:
        BeamboxError: where one is given under both names.
    """
    current: dict[str, Any] = {}
    for name, value in options.items():
        new = name if name in own else FIELDS.get(section + name, name)
        if new != name and new in options:
            raise BeamboxError(
                f"`{section}{name}` is the former name of `{section}{new}`, and both are given: keep one"
            )
        current[new] = _current(value, own.get(new), f"{section}{new}.")
    return current


def _current(value: Any, own: Any, section: str) -> Any:
    """Return a value, its own fields renamed where it is a section or a list of sections."""
    if isinstance(value, Mapping):
        return current_fields(value, own if isinstance(own, Mapping) else {}, section)
    if isinstance(value, list | tuple) and any(isinstance(item, Mapping) for item in value):
        like = next(iter(own), None) if isinstance(own, list | tuple) else None
        return [_current(item, like, section) for item in value]
    return value


def current_names(tensors: Mapping[str, T], renames: Mapping[str, str]) -> dict[str, T]:
    """Return tensors under the names that a network gives them now.

    Args:
        tensors: by name, of a weight file or a checkpoint.
        renames: former beginning of a name -> its beginning now.
    """
    if not renames:
        return dict(tensors)
    table = {part + old: part + new for part in PARTS for old, new in renames.items()}

    def now(name: str) -> str:
        return next((new + name[len(old) :] for old, new in table.items() if name.startswith(old)), name)

    return {now(name): value for name, value in tensors.items()}
