"""Grouping points by the cells of a regular grid."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_dtype, expect_same_length, expect_shape
from beambox.geometry.grid import VoxelGrid
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose, waiting_is_dear
from beambox.ops.voxelize import reference
from beambox.ops.voxelize.voxels import Voxels

__all__ = ["Voxels", "voxelize"]


def _numba() -> Callable[..., Voxels]:
    from beambox.ops.voxelize import cpu

    return cpu.voxelize


def _gpu() -> Callable[..., Voxels]:
    from beambox.ops.voxelize import gpu

    return gpu.voxelize


BACKENDS = (
    Backend("triton", can_run_triton, _gpu),  # of PyTorch's own kernels
    Backend("numba", can_run_numba, _numba),
    Backend("reference", always, lambda: reference.voxelize),
)


def voxelize(
    points: Tensor,
    sample: Tensor,
    batch_size: int,
    grid: VoxelGrid,
    max_points: int | None = None,
    max_voxels: int | None = None,
) -> Voxels:
    """Group points by the cells of a grid, as sparse detectors do before their first layer.

    Points outside the grid, and points with a NaN coordinate, are dropped. Differentiable with respect to ``points``
    (the kept rows are handed on).

    Args:
        points: ``(N, 3 or more)`` float32 or float64; x, y, z in metres in the LiDAR frame, then any features.
        sample: ``(N,)`` int64 number of the sweep each point belongs to.
        batch_size: number of sweeps.
        grid: the cells; :meth:`beambox.geometry.grid.VoxelGrid.index` says which cell a point belongs to.
        max_points: keep only the first so many points of each voxel, in scan order; None keeps all.
        max_voxels: keep only the first so many voxels of each sweep, in order of first appearance; None keeps all.

    Returns:
        The kept points grouped by voxel, and the voxels.

    Raises:
        BeamboxError: if a shape or type does not fit, or, on the CPU, ``sample`` leaves ``0 .. batch_size - 1``.
    """
    expect_shape("points", points, (None, None))
    expect_dtype("points", points, torch.float32, torch.float64)
    if points.shape[1] < 3:
        raise BeamboxError(f"`points` must have at least 3 columns x, y, z, got {points.shape[1]}")
    expect_shape("sample", sample, (None,))
    expect_dtype("sample", sample, torch.int64)
    expect_same_length(points=len(points), sample=len(sample))
    for name, limit in (("max_points", max_points), ("max_voxels", max_voxels)):
        if limit is not None and limit < 1:
            raise BeamboxError(f"`{name}` must be at least 1, or None for no limit, got {limit}")
    if len(sample) and not waiting_is_dear(sample):  # a GPU would have to be waited for
        low, high = (int(value) for value in sample.aminmax())
        if low < 0 or high >= batch_size:
            raise BeamboxError(
                f"`sample` must lie in 0 .. {batch_size - 1} (batch_size {batch_size}), got {low} .. {high}"
            )
    run = choose("voxelize", BACKENDS, points, sample)
    return run(points, sample, batch_size, grid, max_points, max_voxels)
