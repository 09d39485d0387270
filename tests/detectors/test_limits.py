"""Numbers of recipes and weight files that no network has are refused before they take memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

resource = pytest.importorskip("resource")

from beambox.checks import BeamboxError
from beambox.detectors.catalog import CATALOG, build, config_to_dict
from beambox.detectors.limits import ABOVE_ZERO, MAY_BE_NEGATIVE, MAY_BE_ZERO, bounded
from beambox.detectors.weights import load_weights, save_weights


def leaves(values: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    pairs = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in pairs:
        if isinstance(value, dict | list):
            yield from leaves(value, (*place, key))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield (*place, key), value


def changed(values: Any, place: tuple[Any, ...], value: Any) -> Any:
    """Return a copy in which one leaf differs."""
    if not place:
        return value
    copy = dict(values) if isinstance(values, dict) else list(values)
    copy[place[0]] = changed(values[place[0]], place[1:], value)
    return copy


@pytest.mark.parametrize("name", CATALOG)
def test_every_number_of_every_configuration_is_bounded(name: str) -> None:
    options = config_to_dict(CATALOG[name].config())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for place, value in leaves(options):
        for wrong in (10**9, 10**18, -1) if isinstance(value, int) else (1e300, float("nan"), float("inf")):
            with pytest.raises(BeamboxError):
                build(name, changed(options, place, wrong))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "100 MB"


def test_the_names_of_exceptions_are_those_of_fields() -> None:
    fields = {
        next(key for key in reversed(place) if isinstance(key, str))
        for entry in CATALOG.values()
        for place, _ in leaves(config_to_dict(entry.config()))
    }
    assert fields >= MAY_BE_ZERO | MAY_BE_NEGATIVE | ABOVE_ZERO


def test_a_network_beyond_memory_is_refused_before_it_is_filled() -> None:
    width = 1_000_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BeamboxError, match="widths and depths"):
        build("pointpillars", {"widths": [width, width, width]})
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "100 MB"


def test_depth_without_end_is_refused() -> None:
    with pytest.raises(BeamboxError, match="widths and depths"):
        build("pointpillars", {"depths": [1_000_000, 5, 5]})


def test_a_weight_file_cannot_ask_for_more_than_it_holds(tmp_path: Path) -> None:
    path, model = tmp_path / "a.safetensors", build("pointpillars", {"widths": [2048, 128, 256], "depths": [0, 0, 0]})
    save_weights(path, model)
    load_weights(path)  # as large as it says
    tensors = load_file(path)
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    save_file({name: value for name, value in tensors.items() if value.numel() < 1000}, path, metadata=header)
    with pytest.raises(BeamboxError, match="widths and depths"):
        load_weights(path)


def test_what_layers_cannot_be_is_said_in_one_line() -> None:
    with pytest.raises(BeamboxError, match="no toy that can be built"), bounded("toy"):
        nn.Linear(-3, 4)


def test_networks_of_other_threads_and_later_ones_are_not_counted() -> None:
    with bounded("small", most=100):
        nn.Linear(3, 4)
    nn.Linear(100, 100)
    assert nn.Linear(20, 20).weight.dtype == torch.float32
