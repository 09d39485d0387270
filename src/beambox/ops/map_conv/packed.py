"""Weights of a convolution of maps, laid out as the CPU's inner loops read them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from beambox.ops.map_conv.kernel import MapKernel
from beambox.ops.map_conv.tiles import LANES, WIDE

__all__ = ["Packed", "Panels", "Phase"]


class Panels(NamedTuple):
    """A matrix cut into panels of a few vectors; where its width is no whole number of them, the last one overlaps."""

    columns: np.ndarray
    """``(P,)`` int64 first column of each panel."""
    across: np.ndarray
    """``(P,)`` int64 vectors of each."""
    offset: np.ndarray
    """``(P,)`` int64 place of each panel's first number."""
    values: np.ndarray
    """All panels, one after the other, float32."""

    @classmethod
    def of(cls, matrix: Tensor) -> Panels:
        """Cut ``(K, C_out)``, or several of them: ``(M, K, C_out)``, whose panels of one place lie together."""
        matrix = matrix.detach().float()
        width = matrix.shape[-1]
        vectors = width // LANES
        panels = -(-vectors // WIDE)
        edges = [vectors * i // panels for i in range(panels + 1)]
        cuts = [(low * LANES, high - low) for low, high in pairwise(edges)]
        if width % LANES:
            cuts.append((width - LANES, 1))
        columns, across, offset, values, place = [], [], [], [], 0
        for first, wide in cuts:
            columns.append(first)
            across.append(wide)
            offset.append(place)
            values.append(matrix[..., first : first + wide * LANES].contiguous().flatten())
            place += values[-1].numel()
        places = (np.array(numbers, np.int64) for numbers in (columns, across, offset))
        return cls(*places, values=torch.cat(values).numpy())


@dataclass(frozen=True)
class Phase:
    """The taps that make one of the cells which a base cell stands for."""

    at: tuple[int, int]
    """Row and column of the cell among them."""
    taps: np.ndarray
    """``(T, 2)`` int64 rows and columns from the base cell's first input."""
    weights: Panels
    """``(T * C_in, C_out)``."""


@dataclass(frozen=True)
class Packed:
    """A kernel for the CPU.

    A base cell (i, j) reads from input cell ``in_step * (i, j)`` and makes ``out_step`` rows and columns of output
    cells, by one phase each, or all together by Winograd's products.
    """

    in_step: int
    out_step: int
    low: tuple[int, int]
    """First row and column that a base cell reads, from its first input."""
    high: tuple[int, int]
    """Last row and column."""
    phases: tuple[Phase, ...]
    """Empty for Winograd."""
    winograd: Panels | None
    """``(16, C_in, C_out)``."""
    bias: np.ndarray
    """``(C_out,)`` float32."""

    @classmethod
    def of(cls, kernel: MapKernel) -> Packed:
        """Lay out a kernel's weights."""
        bias = kernel.weight.new_zeros(kernel.out_channels) if kernel.bias is None else kernel.bias
        start = bias.detach().float().contiguous().numpy().copy()
        if suits_winograd(kernel):
            return cls(2, 2, (-1, -1), (2, 2), (), Panels.of(winograd_weights(kernel.weight)), start)
        phases = tuple(transposed_phases(kernel) if kernel.transposed else [plain_phase(kernel)])
        taps = np.concatenate([phase.taps for phase in phases if len(phase.taps)])
        low, high = (tuple(int(n) for n in edge) for edge in (taps.min(0), taps.max(0)))
        steps = (1, kernel.stride) if kernel.transposed else (kernel.stride, 1)
        return cls(*steps, low, high, phases, None, start)  # pyright: ignore[reportArgumentType]


def suits_winograd(kernel: MapKernel) -> bool:
    """Tell whether a kernel is a 3 x 3 one that keeps the size."""
    plain = not kernel.transposed and kernel.stride == kernel.padding == kernel.dilation == 1
    return plain and tuple(kernel.weight.shape[2:]) == (3, 3) and kernel.in_channels >= LANES


def winograd_weights(weight: Tensor) -> Tensor:
    """Return ``G g G^T`` of F(2 x 2, 3 x 3): ``(C_out, C_in, 3, 3)`` -> ``(16, C_in, C_out)``, made in float64."""
    g = torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return torch.einsum("yk,oikl,xl->yxio", g, weight.detach().double(), g).flatten(0, 1)


def plain_phase(kernel: MapKernel) -> Phase:
    """Return the taps of a convolution."""
    height, width = kernel.weight.shape[2:]
    rows, columns = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    taps = np.stack((rows.ravel(), columns.ravel()), 1).astype(np.int64) * kernel.dilation - kernel.padding
    matrix = kernel.weight.permute(2, 3, 1, 0).flatten(0, 2)  # (T * C_in, C_out)
    return Phase((0, 0), taps, Panels.of(matrix))


def transposed_phases(kernel: MapKernel) -> list[Phase]:
    """Return the taps of a transposed convolution: output ``y`` sees input ``(y + padding - k) / stride``."""
    step, phases = kernel.stride, []
    for py in range(step):
        for px in range(step):
            taps, matrices = [], []
            for ky in range(kernel.weight.shape[2]):
                for kx in range(kernel.weight.shape[3]):
                    down, right = (p + kernel.padding - k * kernel.dilation for p, k in ((py, ky), (px, kx)))
                    if down % step == 0 and right % step == 0:
                        taps.append((down // step, right // step))
                        matrices.append(kernel.weight[:, :, ky, kx])
            matrix = torch.cat(matrices) if matrices else kernel.weight.new_zeros(0, kernel.out_channels)
            phases.append(Phase((py, px), np.array(taps, np.int64).reshape(-1, 2), Panels.of(matrix)))
    return phases
