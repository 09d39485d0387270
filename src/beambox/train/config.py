"""Recipes: everything a training run needs, in one flat YAML file that is checked before anything starts."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from beambox.checks import BeamboxError, did_you_mean
from beambox.data.augment import AugmentConfig
from beambox.io import parse_yaml, read_text
from beambox.metrics.once import SUPERCLASSES
from beambox.train.recipes import find_recipe

__all__ = [
    "AugmentSection",
    "DetectorSection",
    "EmaSection",
    "OptimSection",
    "Recipe",
    "SourceSection",
    "ValidationSection",
    "apply_overrides",
    "parse_recipe",
    "read_recipe",
]


class Section(BaseModel):
    """A part of a recipe; frozen, and a key it does not know is an error that names the nearest known one."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, validate_default=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, values: Any) -> Any:
        for key in values if isinstance(values, Mapping) else ():
            if key not in cls.model_fields:
                raise ValueError(f'unknown key "{key}"{did_you_mean(str(key), cls.model_fields)}')
        return values


class DetectorSection(Section):
    """Which network."""

    name: str
    """Name in the catalogue, as ``pointpillars``."""
    options: dict[str, Any] = {}
    """Fields of the detector's config that differ from its defaults."""
    start_from: str | None = None
    """Weights to begin with instead of random ones, of the same detector: a shipped name, a .safetensors file or the
    folder of a run. Options that the recipe leaves out are those of the weights; tensors whose shape differs begin
    anew, and the log names them."""


class SourceSection(Section):
    """One set of frames."""

    kind: Literal["kitti", "once", "custom", "simulated"]
    """Layout of the files; ``custom`` is described by a YAML file; ``simulated`` makes sweeps and needs no files."""
    path: str = "{data}"
    """Folder, or the YAML file of a custom one; ``{data}`` stands for what ``--data`` gives."""
    split: str = "train"
    """Name of the list of frames (of sequences, for ONCE)."""
    camera_view: bool = True
    """Keep only points that the camera sees (KITTI labels exist only there)."""
    weight: float | None = Field(default=None, gt=0)
    """Share of the drawn frames that come from this source, relative to the other sources' weights; where no source
    has one, every frame is drawn once per epoch."""
    frames: int | None = Field(default=None, gt=0)
    """Use only this many frames, spread evenly over the source; number of sweeps to make where simulated."""
    objects: bool = True
    """Cut this source's objects into the database of object sampling."""
    sensor: str = "hdl64"
    """Simulated: the LiDAR."""
    layout: str = "random"
    """Simulated: where objects stand (``random`` or ``kitti:PATH``)."""
    seed: int = 0
    """Simulated: seed of the scenes."""


class AugmentSection(AugmentConfig):
    """Random changes to training frames: the fields of ``beambox.data.augment.AugmentConfig``, and the database."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    sample: dict[str, Annotated[int, Field(ge=0, le=1000)]] = Field(default_factory=dict)
    """Objects drawn from the database a frame, by class, in the order of drawing."""
    object_min_points: int = Field(default=5, ge=1)
    """Objects with fewer LiDAR points do not enter the database."""


class OptimSection(Section):
    """Adam with decoupled weight decay, and its schedule."""

    lr: float = Field(default=0.003, gt=0)
    """Highest learning rate."""
    weight_decay: float = Field(default=0.01, ge=0)
    """Every step multiplies every parameter by 1 - lr * weight_decay."""
    epochs: float | None = Field(default=None, gt=0)
    """Passes over the data; give this or ``iterations``."""
    iterations: int | None = Field(default=None, gt=0)
    """Number of optimiser steps; give this or ``epochs``."""
    batch: int = Field(default=4, gt=0, le=4096)
    """Frames in one optimiser step, over all processes together."""
    schedule: Literal["one-cycle", "cosine", "constant"] = "one-cycle"
    """``one-cycle`` rises from lr/10, falls to lr/100000; ``cosine`` rises over ``warmup`` and falls to 0."""
    warmup: float = Field(default=0.4, ge=0, lt=1)
    """Share of the run in which the learning rate rises."""
    clip: float | None = Field(default=10.0, gt=0)
    """Gradients are scaled down to at most this norm; null for never."""

    @model_validator(mode="after")
    def _one_length(self) -> OptimSection:
        if (self.epochs is None) == (self.iterations is None):
            raise ValueError("give either `epochs` or `iterations`, one of the two")
        return self


class EmaSection(Section):
    """Moving average of the weights; it is what is validated and exported."""

    decay: float = Field(default=0.999, gt=0, lt=1)
    """Weight of the past at each step; (1 + step) / (10 + step) while that is smaller."""


class ValidationSection(Section):
    """Scoring during the run: by ONCE's metric where the source is of ``kind: once``, else by KITTI's."""

    source: SourceSection
    """Frames to score on."""
    every: int = Field(default=1000, gt=0)
    """Iterations between two validations; one more follows the last iteration."""
    choose_by: str = "mean"
    """Class whose average precision decides which weights are the best, or ``mean`` over the classes; for ONCE
    Vehicle, Pedestrian, Cyclist or ``mean``, at all distances together."""
    view: Literal["3d", "bev"] = "3d"
    """KITTI: overlap in space or from above."""
    recalls: Literal["R40", "R11", "all"] = "R40"
    """KITTI: recall positions of the average precision; ``all`` suits sets with few objects."""
    level: Literal["easy", "moderate", "hard", "all"] = "moderate"
    """KITTI's difficulty; ``all``: every object counts, as in data without a camera."""
    iou: dict[str, float] = {}
    """Overlap that counts as found, by class, where it differs from the metric's own."""

    @model_validator(mode="after")
    def _fits_the_metric(self) -> ValidationSection:
        if self.source.kind != "once":
            return self
        defaults = {"view": self.view == "3d", "recalls": self.recalls == "R40", "level": self.level == "moderate"}
        for key, kept in defaults.items():
            if not kept:
                raise ValueError(
                    f"`{key}` is of KITTI's metric, and a source of kind once is scored by ONCE's; drop it"
                )
        for key, name in (*(("iou", name) for name in self.iou), ("choose_by", self.choose_by)):
            known = list(SUPERCLASSES) if key == "iou" else [*SUPERCLASSES, "mean"]
            if name not in known:
                raise ValueError(
                    f"`{key}`: ONCE's metric has no class {name!r}{did_you_mean(name, known)}; "
                    "it merges Car, Bus and Truck into Vehicle"
                )
        return self


class Recipe(Section):
    """One training run."""

    name: str
    """Name of the run and of its weights."""
    description: str = ""
    """One sentence: what comes out, and which published result it repeats."""
    takes: str = ""
    """How long it takes, and on what."""
    ran: str = ""
    """Whether it was ever run to the end, and where the result stands."""
    detector: DetectorSection
    """The network."""
    data: tuple[SourceSection, ...] = Field(min_length=1)
    """Where training frames come from."""
    augment: AugmentSection | None = None
    """Random changes to training frames; null for none but the order of points."""
    optim: OptimSection
    """Optimiser and length of the run."""
    validation: ValidationSection | None = None
    """Scoring during the run; null for none."""
    ema: EmaSection | None = EmaSection()
    """Averaging of the weights; null for none."""
    batchnorm_batches: int = Field(default=60, ge=0, le=1_000_000)
    """Before each validation and export the batch norms' statistics are measured anew, exactly, over the batches of
    this many last steps, for the weights that are scored and written; 0 keeps the moving averages of training."""
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Arithmetic of the network; ``auto`` takes bfloat16 where the device is fast at it, else float32."""
    window: tuple[int, int] | None = None
    """Each step sees only a random window of this many grid cells (x, y), around a random object: cheap training of
    fully convolutional detectors on a CPU. Multiples of 8; null for the whole grid."""
    seed: int = 0
    """Of initial weights, order of frames, augmentation and windows."""
    workers: int = Field(default=1, ge=0, le=1024)
    """Processes that prepare data in the background; 0 prepares it in the training process."""
    threads: int | None = Field(default=None, gt=0, le=1024)
    """Threads of torch; null leaves torch's choice."""
    compile: bool = False
    """Compile the dense layers with torch.compile (needs a C++ compiler on a CPU)."""
    sync_batchnorm: bool = False
    """Batch-norm statistics over all GPUs of a run."""
    log_every: int = Field(default=50, gt=0)
    """Iterations between two lines of the log."""
    save_every: int = Field(default=500, gt=0)
    """Iterations between two checkpoints; one more is written at the end and on interruption."""

    @model_validator(mode="after")
    def _consistent(self) -> Recipe:
        weights = [source.weight for source in self.data]
        if any(w is None for w in weights) and any(w is not None for w in weights):
            raise ValueError("data: give every source a `weight`, or none")
        if self.window is not None and any(cells <= 0 or cells % 8 for cells in self.window):
            raise ValueError(f"window: must be positive multiples of 8 cells, got {list(self.window)}")
        return self


def read_recipe(path: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Read a recipe from a YAML file.

    Args:
        path: the name of a shipped recipe, or a file.
        overrides: changes as ``a.b=value``, value in YAML; list entries by position (``data.0.split=val``).

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: if it is not YAML, has an unknown key or a wrong value; the message names the place.
    """
    values = load_recipe(path)
    if "stages" in values:
        raise BeamboxError(f"recipe {path} has stages; read it by `read_stages`, or train it by `beambox train`")
    return parse_recipe(apply_overrides(values, overrides), where=str(path))


def load_recipe(path: str | Path) -> dict[str, Any]:
    """Return the plain values of a recipe, given by its name or file; unchecked but for being a mapping."""
    path = find_recipe(path)
    values = parse_yaml(read_text(path), f"recipe {path}")
    if not isinstance(values, dict):
        raise BeamboxError(f"recipe {path} must be a mapping of keys to values, got {type(values).__name__}")
    return values


def parse_recipe(values: Mapping[str, Any], where: str = "recipe") -> Recipe:
    """Check plain values against the schema of recipes.

    Raises:
        BeamboxError: names every wrong key or value and its place.
    """
    try:
        return Recipe.model_validate(dict(values))
    except ValidationError as error:
        faults = []
        for fault in error.errors():
            place = ".".join(str(part) for part in fault["loc"])
            text = fault["msg"].removeprefix("Value error, ")
            text = text[:1].lower() + text[1:] if fault["type"] != "value_error" else text
            if fault["type"] == "extra_forbidden":  # in the section that comes from beambox.data
                *_, key = fault["loc"]
                place = place.rpartition(".")[0]
                text = f'unknown key "{key}"{did_you_mean(str(key), AugmentSection.model_fields)}'
            plain = {"value_error", "missing", "extra_forbidden"}
            got = "" if fault["type"] in plain else f", got {fault['input']!r}"
            faults.append(f"{place + ': ' if place else ''}{text}{got}")
        raise BeamboxError(f"{where}: " + "; ".join(faults)) from None


def apply_overrides(values: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return ``values`` with changes given as ``a.b=value`` applied; new keys are checked later, by the schema."""
    changed = copy.deepcopy(dict(values))
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key:
            raise BeamboxError(f'`--set` takes key=value as in optim.lr=0.001, got "{override}"')
        value = parse_yaml(text, f'the value of `--set {key}`, "{text[:60]}",')
        if isinstance(value, str):
            value = _number(value)
        *parents, last = key.split(".")
        place: Any = changed
        for part in parents:
            place = _child(place, part, override)
        _assign(place, last, value, override)
    return changed


def _number(text: str) -> str | float:
    """YAML reads 1e-3 as text (it wants 1.0e-3); people write the former."""
    try:
        return float(text)
    except ValueError:
        return text


def _child(place: Any, part: str, override: str) -> Any:
    if isinstance(place, list):
        return place[_position(place, part, override)]
    if place.get(part) is None:
        place[part] = {}
    if not isinstance(place[part], dict | list):
        raise BeamboxError(f'`--set {override}`: "{part}" holds a value, not a section')
    return place[part]


def _assign(place: Any, part: str, value: Any, override: str) -> None:
    place[_position(place, part, override) if isinstance(place, list) else part] = value


def _position(place: list[Any], part: str, override: str) -> int:
    if not part.isdigit() or int(part) >= len(place):
        raise BeamboxError(f'`--set {override}`: "{part}" must be a position from 0 to {len(place) - 1} in the list')
    return int(part)
