"""What every detector of the catalogue must do, whatever it is made of."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from beambox.detectors.catalogue import CATALOGUE
from beambox.structures import Batch
from oracles.small_detectors import CAR, SMALL, car_frame, first_stage, made, total


def test_every_detector_has_a_small_one() -> None:
    assert set(SMALL) == set(CATALOGUE)


@pytest.mark.parametrize("name", CATALOGUE)
def test_dense_layers_hold_most_convolutions_on_maps(name: str) -> None:
    with torch.device("meta"):
        model = CATALOGUE[name].build(CATALOGUE[name].config())
    inside = sum(count(layer) for layer in model.dense)
    assert inside > 0.8 * count(model)


def count(module: nn.Module) -> int:
    layers = [layer for layer in module.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)]
    return sum(layer.weight.numel() for layer in layers)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_compiled_detector_says_and_learns_the_same(name: str) -> None:
    torch.compiler.reset()
    plain, compiled = made(name).eval(), made(name).eval()
    runs: list[Any] = []

    def backend(graph: Any, _: Any) -> Any:
        def run(*inputs: Any) -> Any:
            runs.append(graph)
            return graph.forward(*inputs)

        return run

    for layer in compiled.dense:
        layer.compile(backend=backend, dynamic=False)
    batch = Batch.of([car_frame(1, CAR)])
    gradients = []
    for model in (plain, compiled):
        torch.manual_seed(0)
        total(model.loss(model(batch), batch.labels)).backward()
        gradients.append({key: value.grad for key, value in model.named_parameters()})
    assert len(runs) == len(compiled.dense), "each layer is one graph without a break, and none is passed over"
    for key, gradient in gradients[0].items():
        torch.testing.assert_close(gradients[1][key], gradient, msg=lambda text, key=key: f"{key}: {text}")
    torch.testing.assert_close(first_stage(compiled(batch)).cls, first_stage(plain(batch)).cls)
