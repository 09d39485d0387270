"""Dense twins and random inputs of sparse convolutions."""

from __future__ import annotations

import torch
from torch import Tensor

from beambox.ops.sparse_conv import SparseTensor


def random_sparse(
    seed: int,
    shape: tuple[int, int, int] = (5, 7, 6),
    batch_size: int = 2,
    density: float = 0.2,
    channels: int = 3,
    dtype: torch.dtype = torch.float64,
    empty: tuple[int, ...] = (),
) -> SparseTensor:
    """Draw a sparse tensor in shuffled row order; the samples in ``empty`` hold nothing."""
    generator = torch.Generator().manual_seed(seed)
    active = torch.rand((batch_size, *shape), generator=generator) < density
    active[list(empty)] = False
    indices = torch.nonzero(active)
    indices = indices[torch.randperm(len(indices), generator=generator)]
    features = torch.randn((len(indices), channels), generator=generator, dtype=dtype)
    return SparseTensor.of(features, indices, shape, batch_size)


def dense_weight(weight: Tensor) -> Tensor:
    """Turn ``(kz, ky, kx, C_in, C_out)`` into the layout of conv3d."""
    return weight.permute(4, 3, 0, 1, 2)


def read_at(dense: Tensor, indices: Tensor) -> Tensor:
    """Read ``(B, C, Z, Y, X)`` at ``(V, 4)`` sites: ``(V, C)``."""
    b, z, y, x = indices.unbind(1)
    return dense[b, :, z, y, x]
