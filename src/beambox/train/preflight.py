"""What would make a training fail late, or learn nothing, found before its first step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.source import FrameSource
from beambox.detectors.contract import DetectorConfig
from beambox.geometry.grid import VoxelGrid
from beambox.infer.evaluate import check_classes
from beambox.metrics.once import SUPERCLASS_OF
from beambox.structures import expect_columns
from beambox.train.config import Recipe, ValidationSection

__all__ = ["check_labels", "check_recipe", "check_validation"]

LOOKED_AT = 20
"""Frames whose labels are looked at in any case; more only while none of their objects can be learnt."""


def check_recipe(recipe: Recipe, config: DetectorConfig, processes: int) -> None:
    """Check what the recipe alone can get wrong.

    Args:
        recipe: of the run.
        config: of the detector.
        processes: that share the batch.

    Raises:
        BeamboxError: naming the recipe's key.
    """
    if recipe.optim.batch % processes:
        raise BeamboxError(
            f"optim.batch = {recipe.optim.batch} frames cannot be shared evenly by {processes} processes; "
            f"--set optim.batch={-(-recipe.optim.batch // processes) * processes}, or start fewer"
        )
    for name in recipe.augment.sample if recipe.augment else ():
        if name not in config.classes:
            raise BeamboxError(
                f'augment.sample: the detector has no class "{name}"{did_you_mean(name, config.classes)}; '
                f"it has {', '.join(config.classes)}"
            )
    if recipe.validation:
        check_validation(recipe.validation, config.classes)


def check_validation(section: ValidationSection, classes: Sequence[str]) -> None:
    """Check that the validation can score the detector's classes.

    Raises:
        BeamboxError: naming the recipe's key.
    """
    by_once = section.source.kind == "once"
    merge = SUPERCLASS_OF if by_once else {}
    choices = [*dict.fromkeys(merge.get(name, name) for name in classes), "mean"]
    if section.choose_by not in choices:
        raise BeamboxError(
            f'validation.choose_by: the detector has no class "{section.choose_by}"'
            f"{did_you_mean(section.choose_by, choices)}"
        )
    try:
        check_classes(classes, [section.iou], by_once)
    except BeamboxError as error:
        raise BeamboxError(f"validation.iou: {error}") from None


def check_labels(
    source: FrameSource,
    what: str,
    classes: Sequence[str],
    grid: VoxelGrid,
    log: Callable[[str], None],
    num_point_features: int = 4,
) -> None:
    """Look at the labels of some frames, spread over a source; at more while nothing in them can be learnt.

    Args:
        source: labelled frames.
        what: to call it in messages, such as ``training data``.
        classes: of the detector.
        grid: region that the detector looks at.
        log: told of classes that the frames looked at lack.
        num_point_features: that the detector reads of each point.

    Raises:
        BeamboxError: if there is no frame, one has no labels, an object has no extent, or no object of the whole source
            is of the detector's classes and within its region; says what the labels do hold.
    """
    if len(source) == 0:
        raise BeamboxError(f"the {what} hold no frame")
    names: Counter[str] = Counter()
    inside: Counter[str] = Counter()
    order = np.random.default_rng(0).permutation(len(source))
    looked = 0
    for looked, index in enumerate(order.tolist(), 1):
        frame = source[index]
        expect_columns(frame, num_point_features)
        if frame.labels is None:
            raise BeamboxError(f"frame {frame.id} of the {what} has no labels, which the training needs")
        names.update(frame.labels.names)
        known = frame.labels.of_classes(classes)
        flat = (known.boxes[:, 3:6] <= 0).any(dim=1)
        if bool(flat.any()):
            name = known.names[int(flat.nonzero()[0])]
            raise BeamboxError(
                f"frame {frame.id} of the {what}: a {name} has a length, width or height of 0, which is no box; "
                "`beambox data check` lists such labels"
            )
        inside.update(known[grid.contains(known.boxes)].names)
        if looked >= LOOKED_AT and inside:
            break
    if not inside:
        raise BeamboxError(_nothing(what, looked, names, classes, grid))
    lacking = [name for name in classes if not inside[name]]
    if lacking:
        log(f"note: no {', '.join(lacking)} in the {looked} frames of the {what} looked at; they hold {_counts(names)}")


def _counts(names: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in names.most_common(8)) or "no object"


def _nothing(what: str, looked: int, names: Counter[str], classes: Sequence[str], grid: VoxelGrid) -> str:
    """Say why nothing can be learnt."""
    known = [name for name in classes if names[name]]
    if known:
        (x0, y0, z0), (x1, y1, z1) = grid.minimum, grid.maximum
        return (
            f"every {' and '.join(known)} in the {looked} frames of the {what} lies outside the detector's region, "
            f"x {x0:g} to {x1:g}, y {y0:g} to {y1:g}, z {z0:g} to {z1:g} m; look at detector.options.grid, and at the "
            "units and axes of the labels with `beambox data check`"
        )
    hints = [did_you_mean(name, classes) for name in names]
    hint = next((hint for hint in hints if "did you mean" in hint), "")
    return (
        f"none of the labels in the {looked} frames of the {what} is of the detector's classes {', '.join(classes)}; "
        f"they hold {_counts(names)}{hint}"
    )
