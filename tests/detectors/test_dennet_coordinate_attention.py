"""Coordinate attention against its definition, gate by gate."""

from __future__ import annotations

import math

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.dennet import CoordinateAttention


@torch.no_grad()
def test_agrees_with_its_definition() -> None:
    torch.manual_seed(0)
    module = CoordinateAttention(3).double().eval()
    mix, norm, _ = module.shared
    norm.running_mean.normal_()
    norm.running_var.uniform_(0.5, 2)
    bev = torch.randn(2, 3, 4, 5, dtype=torch.float64)

    def hidden(strip: torch.Tensor) -> torch.Tensor:
        """(C,) mean of a row or column to (m,)."""
        t = mix.weight[:, :, 0, 0] @ strip + mix.bias
        t = (t - norm.running_mean) / torch.sqrt(norm.running_var + norm.eps) * norm.weight + norm.bias
        return t * (t + 3).clamp(0, 6) / 6

    out = module(bev)
    for b in range(2):
        for i in range(4):
            for j in range(5):
                row = module.rows.weight[:, :, 0, 0] @ hidden(bev[b, :, i].mean(dim=1)) + module.rows.bias
                column = module.columns.weight[:, :, 0, 0] @ hidden(bev[b, :, :, j].mean(dim=1)) + module.columns.bias
                expected = bev[b, :, i, j] * torch.sigmoid(row) * torch.sigmoid(column)
                torch.testing.assert_close(out[b, :, i, j], expected, atol=1e-10, rtol=1e-8)


@torch.no_grad()
def test_gates_without_weights_are_halves() -> None:
    module = CoordinateAttention(4)
    for gate in (module.rows, module.columns):
        gate.weight.zero_()
        gate.bias.zero_()
    bev = torch.randn(1, 4, 3, 6)
    torch.testing.assert_close(module(bev), bev / 4)


def test_parameters_of_the_published_modules() -> None:
    sizes = [sum(p.numel() for p in CoordinateAttention(c).parameters()) for c in (64, 128)]
    assert sum(sizes) == 5040
    assert CoordinateAttention(512).shared[0].out_channels == 16


def test_gradients_reach_every_parameter() -> None:
    torch.manual_seed(0)
    module = CoordinateAttention(4)
    bev = torch.randn(2, 4, 5, 7, requires_grad=True)
    (module(bev) * torch.randn(2, 4, 5, 7)).sum().backward()
    assert bev.grad is not None and math.isfinite(float(bev.grad.sum()))
    unfed = [name for name, p in module.named_parameters() if p.grad is None or not bool(p.grad.isfinite().all())]
    assert unfed == []


def test_other_channels_are_refused() -> None:
    with pytest.raises(BeamboxError, match="`bev` must have shape"):
        CoordinateAttention(4)(torch.zeros(1, 5, 3, 3))
