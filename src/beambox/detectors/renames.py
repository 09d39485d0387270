"""What fields and tensors were called before: old recipes, weights and checkpoints go on loading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from beambox.checks import BeamboxError

__all__ = ["FIELDS", "current_fields", "current_names"]

FIELDS = {
    "max_pillars": "max_voxels",  # PointPillars, 0.1.0
    "pillar_channels": "voxel_channels",  # PointPillars, 0.1.0
}
"""Former name of a configuration's field -> its name, the same for every detector."""

PARTS = ("", "model.", "ema.", "optim.")
"""What stands before a tensor's name: nothing in weights, the rest in checkpoints."""

T = TypeVar("T")


def current_fields(options: Mapping[str, T]) -> dict[str, T]:
    """Return options under the names that configurations have now.

    Raises:
        BeamboxError: where one is given under both names.
    """
    both = [old for old, new in FIELDS.items() if old in options and new in options]
    if both:
        raise BeamboxError(f"`{both[0]}` is the former name of `{FIELDS[both[0]]}`, and both are given: keep one")
    return {FIELDS.get(name, name): value for name, value in options.items()}


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
