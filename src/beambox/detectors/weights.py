"""Weights on disk: safetensors with the configuration inside; loading never runs pickled code."""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from beambox.checks import BeamboxError, MissingFileError
from beambox.detectors.catalog import build, config_to_dict, name_of, tensors_since
from beambox.detectors.contract import AnyModel, module_of
from beambox.io import parse_json, write_bytes

__all__ = ["WeightFile", "load_weights", "read_weights", "save_weights"]

FORMAT = "beambox-weights-1"

log = logging.getLogger("beambox")


@dataclass(frozen=True)
class WeightFile:
    """What a weight file holds."""

    detector: str
    """Name in the catalogue."""
    config: dict[str, Any]
    """Its configuration as plain values."""
    card: dict[str, Any]
    """Where the weights come from: data, recipe, licence, scores."""
    tensors: dict[str, Tensor]
    """Parameters and buffers."""


def save_weights(
    path: str | Path,
    model: AnyModel,
    card: Mapping[str, Any] | None = None,
    *,
    tensors: Mapping[str, Tensor] | None = None,
    half: bool = False,
) -> None:
    """Write a model's weights and configuration.

    Args:
        path: file to write, ending in .safetensors.
        model: a detector of the catalogue.
        card: what to say of the weights.
        tensors: values to write in place of the model's own (an average, say).
        half: store floating-point values as float16.

    Raises:
        BeamboxError: if the file cannot be written; an older file of that name is then still whole.
    """
    values = {}
    for name, value in (tensors if tensors is not None else model.state_dict()).items():
        tensor = value.detach().cpu()
        values[name] = (tensor.half() if half and tensor.is_floating_point() else tensor).contiguous()
    header = {
        "format": FORMAT,
        "detector": name_of(model),
        "config": json.dumps(config_to_dict(model.config), sort_keys=True),
        "card": json.dumps(dict(card or {})),
    }
    write_bytes(Path(path), save(values, metadata=header), sync=True)


def read_weights(path: str | Path) -> WeightFile:
    """Read a weight file without building anything.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: if it is not a weight file of this package or is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"no weight file {path}; `beambox models` lists the shipped ones")
    try:
        with safe_open(str(path), framework="pt", device="cpu") as stream:
            header = stream.metadata() or {}
            if header.get("format") != FORMAT:
                raise BeamboxError(
                    f"{path} is a safetensors file, but not one of beambox's (no format {FORMAT} in its header)"
                )
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}
        detector = header["detector"]
        config, card = (parse_json(header[part], f"{path}, its {part}") for part in ("config", "card"))
    except (SafetensorError, OSError, KeyError) as error:
        raise BeamboxError(
            f"{path} is not a readable weight file ({error}); expected a whole .safetensors file written by beambox. "
            "A checkpoint of OpenPCDet is converted by `beambox import-openpcdet`"
        ) from error
    if not isinstance(config, dict) or not isinstance(card, dict):
        raise BeamboxError(f"{path} is a damaged weight file: its config and its card must be mappings")
    return WeightFile(detector, config, card, tensors)


def load_weights(path: str | Path, device: torch.device | str = "cpu") -> AnyModel:
    """Build the model a weight file describes and fill it; the model is in evaluation mode.

    Raises:
        BeamboxError: if the file cannot be read or its tensors do not fit its configuration.
    """
    stored = read_weights(path)
    warn_of_licence(Path(path).stem, str(stored.card.get("licence", "")))
    tensor = sum(value.numel() for value in stored.tensors.values())
    # what the file does not hold is refused before it takes memory; some buffers need not be in it
    model = build(stored.detector, stored.config, most=2 * tensor + 1_000_000)
    fill(model, stored.tensors, str(path))
    module_of(model).to(device).eval()
    return model


@functools.cache  # once per process
def warn_of_licence(name: str, licence: str) -> None:
    """Say that weights may not be used commercially, where their card does."""
    if "-NC-" in licence.upper():
        log.warning("the weights %s are not free for commercial use: %s", name, licence)


def fill(model: AnyModel, tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy tensors into a model, in the model's own element types; every name and shape must fit.

    Raises:
        BeamboxError: naming the first tensor that is missing, unknown or of another shape.
    """
    own, tensors = model.state_dict(), tensors_since(model, tensors)
    missing, unknown = sorted(own.keys() - tensors.keys()), sorted(tensors.keys() - own.keys())
    if missing or unknown:
        problems = [f"lacks {missing[0]} and {len(missing) - 1} more"] if missing else []
        problems += [f"has {unknown[0]} and {len(unknown) - 1} more that the model does not know"] if unknown else []
        raise BeamboxError(f"{where} does not fit this {type(model).__name__}: it {' and '.join(problems)}")
    for name, value in own.items():
        if value.shape != tensors[name].shape:
            raise BeamboxError(
                f"{where} does not fit this {type(model).__name__}: {name} has shape {tuple(tensors[name].shape)}, "
                f"expected {tuple(value.shape)}"
            )
        value.copy_(tensors[name])
