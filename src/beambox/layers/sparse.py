"""Sparse 3-D convolutions as layers (Graham et al., 2018; SECOND, section 3.1)."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn import functional

from beambox.ops.sparse_conv import (
    ConvSpec,
    Sites,
    SparseTensor,
    Triple,
    inverse_conv3d,
    sparse_conv3d,
    submanifold_conv3d,
)

__all__ = [
    "InverseConv3d",
    "SparseBlock",
    "SparseConv3d",
    "SubmanifoldConv3d",
    "levels_left",
    "sparse_block",
    "submanifold_block",
]

BN_EPS = 1e-3
BN_MOMENTUM = 0.01


def triple(value: int | Triple) -> Triple:
    """Return a size for each axis (z, y, x)."""
    return (value, value, value) if isinstance(value, int) else value


class _Convolution(nn.Module):
    """Weight ``(K, C_in, C_out)``, the K offsets of the kernel (z, y, x) with x fastest, and bias.

    The weight has three dimensions so that a network with dense convolutions can be moved to ``channels_last``.
    """

    def __init__(self, in_channels: int, channels: int, spec: ConvSpec, bias: bool) -> None:
        super().__init__()
        self.spec = spec
        self.weight = nn.Parameter(torch.empty(spec.offsets, in_channels, channels))
        self.bias = nn.Parameter(torch.empty(channels)) if bias else None
        bound = 1 / math.sqrt(spec.offsets * in_channels)  # as torch's dense convolutions start
        nn.init.uniform_(self.weight, -bound, bound)
        if self.bias is not None:
            nn.init.uniform_(self.bias, -bound, bound)

    def kernel(self, scale: Tensor | None = None) -> Tensor:
        """Return the weight as ``(kz, ky, kx, C_in, C_out)``, each output channel multiplied by ``scale``."""
        weight = self.weight if scale is None else self.weight * scale
        return weight.unflatten(0, self.spec.kernel)


class SubmanifoldConv3d(_Convolution):
    """Convolution that keeps the active sites."""

    def __init__(
        self,
        in_channels: int,
        channels: int,
        kernel: int | Triple = 3,
        dilation: int | Triple = 1,
        bias: bool = True,
    ) -> None:
        super().__init__(in_channels, channels, ConvSpec.centered(triple(kernel), triple(dilation)), bias)

    def forward(self, x: SparseTensor, scale: Tensor | None = None, shift: Tensor | None = None) -> SparseTensor:
        """Convolve; ``scale`` and ``shift``, one value an output channel, replace the bias by an affine map."""
        bias = _affine(self.bias, scale, shift)
        return submanifold_conv3d(x, self.kernel(scale), bias, self.spec.dilation)


class _Strided(_Convolution):
    """Convolution between two resolutions."""

    def __init__(
        self,
        in_channels: int,
        channels: int,
        kernel: int | Triple = 3,
        stride: int | Triple = 1,
        padding: int | Triple = 0,
        dilation: int | Triple = 1,
        bias: bool = True,
    ) -> None:
        spec = ConvSpec(triple(kernel), triple(stride), triple(padding), triple(dilation))
        super().__init__(in_channels, channels, spec, bias)


class SparseConv3d(_Strided):
    """Strided convolution that activates every output within reach of an active input."""

    def forward(self, x: SparseTensor, scale: Tensor | None = None, shift: Tensor | None = None) -> SparseTensor:
        """Convolve; ``scale`` and ``shift``, one value an output channel, replace the bias by an affine map."""
        bias = _affine(self.bias, scale, shift)
        spec = self.spec
        return sparse_conv3d(x, self.kernel(scale), bias, spec.stride, spec.padding, spec.dilation)


class InverseConv3d(_Strided):
    """Transposed convolution onto the sites that a :class:`SparseConv3d` of the same geometry started from."""

    def forward(self, x: SparseTensor, onto: Sites) -> SparseTensor:
        """Carry features back onto ``onto``."""
        spec = self.spec
        return inverse_conv3d(x, self.kernel(), onto, self.bias, spec.stride, spec.padding, spec.dilation)


def _affine(bias: Tensor | None, scale: Tensor | None, shift: Tensor | None) -> Tensor | None:
    if scale is None or shift is None:
        return bias
    return shift if bias is None else shift + bias * scale


class SparseBlock(nn.Module):
    """Convolution, batch norm over the active sites, ReLU; in evaluation mode folded into one convolution."""

    def __init__(self, conv: SubmanifoldConv3d | SparseConv3d) -> None:
        super().__init__()
        self.conv = conv
        self.norm: nn.BatchNorm1d | nn.Identity = nn.BatchNorm1d(
            conv.weight.shape[-1], eps=BN_EPS, momentum=BN_MOMENTUM
        )

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Map ``(V_in, C_in)`` features at sites to ``(V_out, C_out)``."""
        if isinstance(self.norm, nn.Identity):
            out = self.conv(x)
            return out.with_features(functional.relu(out.features, inplace=not out.features.requires_grad))
        if not self.training:
            out = self.conv(x, *self.affine(self.norm))
            return out.with_features(functional.relu(out.features, inplace=not out.features.requires_grad))
        out = self.conv(x)
        if len(out.features) < 2:  # batch statistics need two values
            features = functional.batch_norm(
                out.features,
                self.norm.running_mean,
                self.norm.running_var,
                self.norm.weight,
                self.norm.bias,
                eps=self.norm.eps,
            )
        else:
            features = self.norm(out.features)
        return out.with_features(functional.relu(features, inplace=True))

    @staticmethod
    def affine(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
        """Return scale and shift of a batch norm in evaluation mode."""
        mean, variance = norm.running_mean, norm.running_var
        assert mean is not None and variance is not None
        scale = norm.weight / torch.sqrt(variance + norm.eps)
        return scale, norm.bias - mean * scale

    @torch.no_grad()
    def fold(self) -> None:
        """Take the batch norm into the convolution for good; training ends here."""
        if isinstance(self.norm, nn.Identity):
            return
        scale, shift = self.affine(self.norm)
        bias = _affine(self.conv.bias, scale, shift)
        self.conv.weight = nn.Parameter(self.conv.weight * scale)
        self.conv.bias = None if bias is None else nn.Parameter(bias)
        self.norm = nn.Identity()


def submanifold_block(in_channels: int, channels: int, kernel: int | Triple = 3) -> SparseBlock:
    """Submanifold convolution without bias, batch norm (eps 1e-3, momentum 0.01), ReLU."""
    return SparseBlock(SubmanifoldConv3d(in_channels, channels, kernel, bias=False))


def sparse_block(
    in_channels: int, channels: int, kernel: int | Triple, stride: int | Triple, padding: int | Triple
) -> SparseBlock:
    """Strided sparse convolution without bias, batch norm (eps 1e-3, momentum 0.01), ReLU."""
    return SparseBlock(SparseConv3d(in_channels, channels, kernel, stride, padding, bias=False))


def levels_left(blocks: Iterable[nn.Module], levels: int) -> int:
    """Return how many height levels strided sparse blocks leave of so many.

    Raises:
        BeamboxError: where one has less height than its kernel needs.
    """
    shape = (levels, 64, 64)
    for block in blocks:
        assert isinstance(block, SparseBlock)
        shape = block.conv.spec.output_shape(shape)
    return shape[0]
