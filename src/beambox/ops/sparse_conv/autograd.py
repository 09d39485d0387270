"""Gradients of a sparse convolution from two products: along a map, and of the two ends of its pairs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from beambox.ops.sparse_conv.sites import KernelMap

__all__ = ["convolve_with"]

Forward = Callable[[Tensor, Tensor, Tensor | None, KernelMap], Tensor]
"""``(V_in, C_in), (K, C_in, C_out), (C_out,), pairs -> (V_out, C_out)``, without recording gradients."""
WeightGrad = Callable[[Tensor, Tensor, KernelMap], Tensor]
"""``(V_in, C_in), (V_out, C_out), pairs -> (K, C_in, C_out)``: the weights' gradient."""


def convolve_with(
    forward: Forward,
    weight_grad: WeightGrad,
    features: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    pairs: KernelMap,
) -> Tensor:
    """Convolve differentiably, given one backend's two products."""
    return _Convolution.apply(features, weight, bias, pairs, forward, weight_grad)


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        pairs: KernelMap,
        forward: Forward,
        weight_grad: WeightGrad,
    ) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.pairs, ctx.forward, ctx.weight_grad = pairs, forward, weight_grad
        return forward(features.detach(), weight.detach(), None if bias is None else bias.detach(), pairs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        features, weight = ctx.saved_tensors
        of_features = of_weight = of_bias = None
        if ctx.needs_input_grad[0]:
            of_features = ctx.forward(grad, weight.transpose(1, 2), None, ctx.pairs.inverse)
        if ctx.needs_input_grad[1]:
            of_weight = ctx.weight_grad(features, grad, ctx.pairs)
        if ctx.needs_input_grad[2]:
            of_bias = grad.t().contiguous().sum(dim=1)  # one thread per channel, so that bits do not depend on threads
        return of_features, of_weight, of_bias, None, None, None
