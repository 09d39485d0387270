"""Names of the detectors: the one place where a string chooses code."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from beambox.checks import BeamboxError, did_you_mean
from beambox.detectors.contract import AnyModel
from beambox.detectors.dennet import DenNetConfig, dennet, names_since
from beambox.detectors.hcnet import NAMES_SINCE as HCNET_NAMES
from beambox.detectors.hcnet import HCNetConfig, hcnet
from beambox.detectors.kassd import KASSDConfig, kassd
from beambox.detectors.limits import MOST_ELEMENTS, bounded, check_numbers
from beambox.detectors.pointpillars import PointPillarsConfig, pointpillars
from beambox.detectors.renames import current_fields, current_names
from beambox.detectors.second import SECONDConfig, second
from beambox.detectors.voxel_rcnn import VoxelRCNNConfig, voxel_rcnn

__all__ = ["CATALOG", "CatalogEntry", "build", "config_from_dict", "config_to_dict", "options_since", "tensors_since"]

T = TypeVar("T")


@dataclass(frozen=True)
class CatalogEntry:
    """A detector: its configuration and how it is built from one."""

    config: type
    build: Callable[[Any], AnyModel]
    renames: Callable[[Any], Mapping[str, str]] = lambda _config: {}
    """For a configuration: how the names of tensors began in former versions -> how they begin now."""


CATALOG: dict[str, CatalogEntry] = {
    "dennet": CatalogEntry(DenNetConfig, dennet, names_since),
    "hcnet": CatalogEntry(HCNetConfig, hcnet, lambda _config: HCNET_NAMES),
    "kassd": CatalogEntry(KASSDConfig, kassd),
    "pointpillars": CatalogEntry(PointPillarsConfig, pointpillars),
    "second": CatalogEntry(SECONDConfig, second),
    "voxel_rcnn": CatalogEntry(VoxelRCNNConfig, voxel_rcnn),
}


def build(name: str, options: Mapping[str, Any] | None = None, most: int = MOST_ELEMENTS) -> AnyModel:
    """Build a detector by name.

    Args:
        name: a key of :data:`CATALOG`, or of a detector that an installed package brings (:func:`entry_of`).
        options: fields of its configuration that differ from the defaults, as plain values (from YAML or JSON).
        most: values that all parameters and buffers may have together.

    Raises:
        BeamboxError: for an unknown name, an unknown field, a value of the wrong type, or a network that is too large.
    """
    entry = entry_of(name)
    config = config_from_dict(entry.config, options or {})
    with bounded(name, most):
        return entry.build(config)


def entry_of(name: str) -> CatalogEntry:
    """Look a detector up: one of ours, or an entry point of the group ``beambox.detectors`` of an installed package.

    Such a package names a :class:`CatalogEntry` in its pyproject.toml; it is imported when its name is asked for.

    Raises:
        BeamboxError: for an unknown name, or an entry point that is no :class:`CatalogEntry`.
    """
    if name in CATALOG:
        return CATALOG[name]
    brought = {one.name: one for one in entry_points(group="beambox.detectors")}
    if name not in brought:
        raise BeamboxError(f'no detector is called "{name}"{did_you_mean(name, [*CATALOG, *brought])}')
    entry = brought[name].load()
    if not isinstance(entry, CatalogEntry):
        raise BeamboxError(
            f'the entry point "{name}" of the group beambox.detectors ({brought[name].value}) must be a '
            f"beambox.detectors.catalog.CatalogEntry, got {type(entry).__name__}"
        )
    CATALOG[name] = entry
    return entry


def name_of(model: AnyModel) -> str:
    """Return the catalogue's name of a model, found by the type of its configuration."""
    for name, entry in CATALOG.items():
        if type(getattr(model, "config", None)) is entry.config:  # DenNet's extends Voxel R-CNN's
            return name
    raise BeamboxError(f"{type(model).__name__} is not in the catalogue of detectors")


def options_since(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of a detector, of a recipe or a weight file, under the names that its fields have now.

    Raises:
        BeamboxError: for an unknown detector, or where an option is given under both names.
    """
    return current_fields(options, config_to_dict(entry_of(name).config()))


def tensors_since(model: AnyModel, tensors: Mapping[str, T]) -> dict[str, T]:
    """Return tensors of a weight file or a checkpoint under the names that the model gives them now."""
    return current_names(tensors, CATALOG[name_of(model)].renames(model.config))


def config_to_dict(config: Any) -> dict[str, Any]:
    """Turn a configuration into plain values that :func:`config_from_dict` reads back."""
    return TypeAdapter(type(config)).dump_python(config, mode="json")


def config_from_dict(config_type: type, options: Mapping[str, Any]) -> Any:
    """Turn plain values into a checked configuration; what they leave out, at any depth, is as in ``config_type()``.

    Raises:
        BeamboxError: naming the field, with the nearest known one where it does not exist.
    """
    defaults = config_to_dict(config_type())
    complete = _completed(current_fields(options, defaults), defaults, config_type.__name__)
    try:
        config = TypeAdapter(config_type).validate_python(complete)
    except ValidationError as error:
        first = error.errors()[0]
        where, given = ".".join(str(part) for part in first["loc"]), first["input"]
        words = re.findall("'([^']+)'", first.get("ctx", {}).get("expected", "")) if first["type"] == "enum" else []
        hint = did_you_mean(given, words) if words and isinstance(given, str) else ""
        raise BeamboxError(f"`{where}`: {first['msg']}, got {given!r}{hint}") from None
    check_numbers(config_to_dict(config))  # now that whole numbers stand for lengths where a length is meant
    return config


def _completed(options: Mapping[str, Any], defaults: Mapping[str, Any], owner: str, prefix: str = "") -> dict[str, Any]:
    """Fill settings that are given in part from the defaults of this detector, not from those of the setting's type."""
    complete = dict(defaults)
    for key, value in options.items():
        if key not in defaults:
            raise BeamboxError(f'{owner} has no field "{prefix}{key}"{did_you_mean(key, defaults)}')
        nested = isinstance(value, Mapping) and isinstance(defaults[key], Mapping)
        complete[key] = _completed(value, defaults[key], owner, f"{prefix}{key}.") if nested else value
    return complete
