"""Folding batch norms changes the work, not the result."""

from __future__ import annotations

import torch
from torch import nn

from beambox.infer.bn_folding import fold_batch_norms
from beambox.structures import Batch, Frame
from oracles.tiny_detector import street, tiny_model


def test_folded_detector_predicts_the_same() -> None:
    model = tiny_model()
    batch = Batch.of([Frame(torch.from_numpy(street()))])
    with torch.no_grad():
        plain, folded = model(batch), fold_batch_norms(model)(batch)
    assert plain.cls.std() > 0.1, "a network that says the same everywhere would prove nothing"
    for name in ("cls", "box", "direction"):
        assert torch.allclose(vars(plain)[name], vars(folded)[name], atol=2e-5), name


def test_every_norm_after_a_convolution_is_folded_and_the_model_is_left_alone() -> None:
    model = tiny_model()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    folded = fold_batch_norms(model)
    assert not any(isinstance(layer, nn.BatchNorm2d) for layer in folded.modules())
    assert any(isinstance(layer, nn.BatchNorm2d) for layer in model.modules())
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_linear_and_transposed_layers_are_folded_and_a_lone_norm_is_kept() -> None:
    torch.manual_seed(0)
    chain = nn.Sequential(
        nn.ConvTranspose2d(3, 5, 2, 2, bias=False), nn.BatchNorm2d(5), nn.ReLU(), nn.BatchNorm2d(5), nn.Flatten(),
        nn.Linear(5 * 64, 7), nn.BatchNorm1d(7),
    )  # fmt: skip
    for layer in chain:
        if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
            layer.running_mean.normal_()
            layer.running_var.uniform_(0.5, 2)
    chain.eval()
    folded = fold_batch_norms(chain)
    x = torch.randn(2, 3, 4, 4)
    assert torch.allclose(chain(x), folded(x), atol=1e-5)
    assert [type(layer) for layer in folded] == [
        nn.ConvTranspose2d, nn.Identity, nn.ReLU, nn.BatchNorm2d, nn.Flatten, nn.Linear, nn.Identity,
    ]  # fmt: skip
