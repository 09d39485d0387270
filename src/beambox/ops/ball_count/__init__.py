"""How many voxels lie around each voxel: the density that DenNet attends to."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_dtype, expect_shape
from beambox.ops.ball_count import reference
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose

__all__ = ["ball_count", "ball_counts"]


def _numba() -> Callable[..., Tensor]:
    from beambox.ops.ball_count import cpu

    return cpu.ball_counts


def _triton() -> Callable[..., Tensor]:
    from beambox.ops.ball_count import gpu

    return gpu.ball_counts


BACKENDS = (
    Backend("triton", can_run_triton, _triton),
    Backend("numba", can_run_numba, _numba),
    Backend("reference", always, lambda: reference.ball_counts),
)


def ball_count(index: Tensor, cell: tuple[float, float, float], radius: float) -> Tensor:
    """Count, for each voxel, the voxels of its sample whose centres lie within a radius of its own centre.

    The voxel itself counts, so every count is at least 1. The count is exact and has no upper limit; centres at the
    radius count (squared distances are compared with a tolerance of 1e-6 square metres). A voxel that stands twice in
    ``index`` counts once. No gradient.

    Args:
        index: ``(V, 4)`` int64 (sample, z, y, x).
        cell: edge lengths of a voxel x, y, z in metres.
        radius: metres.

    Returns:
        ``(V,)`` int64.

    Raises:
        BeamboxError: if a shape or type does not fit, or a length is not positive.
    """
    return ball_counts(index, cell, (radius,))[:, 0]


def ball_counts(
    index: Tensor,
    cell: tuple[float, float, float],
    radii: Sequence[float],
    extent: tuple[int, int, int, int] | None = None,
) -> Tensor:
    """Count as :func:`ball_count` does for several radii at once, ``(V, R)`` int64; the map is built once.

    Args:
        index: ``(V, 4)`` int64 (sample, z, y, x).
        cell: edge lengths of a voxel x, y, z in metres.
        radii: metres.
        extent: (samples, z, y, x): indices are known to lie in ``0 .. extent - 1``; where None they are looked at,
            for which a GPU is waited for.

    Raises:
        BeamboxError: if a shape or type does not fit, or a length is not positive.
    """
    expect_shape("index", index, (None, 4))
    expect_dtype("index", index, torch.int64)
    for radius in radii:
        if not (radius > 0 and len(cell) == 3 and min(cell) > 0):
            raise BeamboxError(
                f"`radius` and the three lengths of `cell` must be positive, got {radius} and {tuple(cell)}"
            )
    if len(index) == 0 or not radii:
        return torch.zeros(len(index), len(radii), dtype=torch.int64, device=index.device)
    return choose("ball_count", BACKENDS, index)(index, cell, tuple(radii), extent)
