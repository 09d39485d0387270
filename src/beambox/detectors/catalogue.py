"""Names of the detectors: the one place where a string chooses code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from pydantic import TypeAdapter, ValidationError
from torch import nn

from beambox.checks import BeamboxError, did_you_mean
from beambox.detectors.dennet import DenNetConfig, dennet
from beambox.detectors.hcnet import HCNetConfig, hcnet
from beambox.detectors.kassd import KassdConfig, kassd
from beambox.detectors.pointpillars import PointPillarsConfig, pointpillars
from beambox.detectors.second import SecondConfig, second
from beambox.detectors.voxel_rcnn import VoxelRcnnConfig, voxel_rcnn

__all__ = ["CATALOGUE", "CatalogueEntry", "build", "config_from_dict", "config_to_dict"]


@dataclass(frozen=True)
class CatalogueEntry:
    """A detector: its configuration and how it is built from one."""

    config: type
    build: Callable[[Any], nn.Module]


CATALOGUE: dict[str, CatalogueEntry] = {
    "dennet": CatalogueEntry(DenNetConfig, dennet),
    "hcnet": CatalogueEntry(HCNetConfig, hcnet),
    "kassd": CatalogueEntry(KassdConfig, kassd),
    "pointpillars": CatalogueEntry(PointPillarsConfig, pointpillars),
    "second": CatalogueEntry(SecondConfig, second),
    "voxel_rcnn": CatalogueEntry(VoxelRcnnConfig, voxel_rcnn),
}


def build(name: str, options: Mapping[str, Any] | None = None) -> Any:
    """Build a detector by name.

    Args:
        name: a key of :data:`CATALOGUE`.
        options: fields of its configuration that differ from the defaults, as plain values (from YAML or JSON).

    Raises:
        BeamboxError: for an unknown name, an unknown field or a value of the wrong type.
    """
    entry = entry_of(name)
    return entry.build(config_from_dict(entry.config, options or {}))


def entry_of(name: str) -> CatalogueEntry:
    """Look a detector up."""
    if name not in CATALOGUE:
        raise BeamboxError(f'no detector is called "{name}"{did_you_mean(name, CATALOGUE)}')
    return CATALOGUE[name]


def name_of(model: nn.Module) -> str:
    """Return the catalogue's name of a model, found by the type of its configuration."""
    for name, entry in CATALOGUE.items():
        if type(getattr(model, "config", None)) is entry.config:  # DenNet's extends Voxel R-CNN's
            return name
    raise BeamboxError(f"{type(model).__name__} is not in the catalogue of detectors")


def config_to_dict(config: Any) -> dict[str, Any]:
    """Turn a configuration into plain values that :func:`config_from_dict` reads back."""
    return TypeAdapter(type(config)).dump_python(config, mode="json")


def config_from_dict(config_type: type, options: Mapping[str, Any]) -> Any:
    """Turn plain values into a checked configuration.

    Raises:
        BeamboxError: naming the field, with the nearest known one where it does not exist.
    """
    _refuse_unknown(config_type, options, "")
    try:
        return TypeAdapter(config_type).validate_python(dict(options))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise BeamboxError(f"`{where}`: {first['msg']}, got {first['input']!r}") from None


def _refuse_unknown(config_type: type, options: Mapping[str, Any], prefix: str) -> None:
    known = {f.name: f for f in fields(config_type)}
    for key, value in options.items():
        if key not in known:
            raise BeamboxError(f'{config_type.__name__} has no field "{prefix}{key}"{did_you_mean(key, known)}')
        default = known[key].default_factory if callable(known[key].default_factory) else type(known[key].default)
        if isinstance(value, Mapping) and isinstance(default, type) and is_dataclass(default):
            _refuse_unknown(default, value, f"{prefix}{key}.")
