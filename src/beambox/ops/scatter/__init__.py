"""Sums, means and maxima over groups of rows, and rows laid onto a bird's-eye-view map.

While ``torch.export`` traces a network, no value is known that could be checked: then ``graph.py`` runs, unchecked.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_dtype, expect_same_length, expect_shape
from beambox.ops.dispatch import (
    Backend,
    always,
    can_run_graph,
    can_run_numba,
    can_run_triton,
    choose,
    exporting,
    waiting_is_dear,
)
from beambox.ops.scatter import graph, reference

__all__ = ["scatter_bev", "segment_max", "segment_mean", "segment_sum"]


def _numba_max() -> Callable[..., Tensor]:
    from beambox.ops.scatter import cpu

    return cpu.segment_max


def _triton_max() -> Callable[..., Tensor]:
    from beambox.ops.scatter import gpu

    return gpu.segment_max


def _triton_sum() -> Callable[..., Tensor]:
    from beambox.ops.scatter import gpu

    return gpu.segment_sum


def _triton_mean() -> Callable[..., Tensor]:
    from beambox.ops.scatter import gpu

    return gpu.segment_mean


SUM_BACKENDS = (
    Backend("graph", can_run_graph, lambda: graph.segment_sum),
    Backend("triton", can_run_triton, _triton_sum),
    Backend("reference", always, lambda: reference.segment_sum),
)
MEAN_BACKENDS = (
    Backend("graph", can_run_graph, lambda: graph.segment_mean),
    Backend("triton", can_run_triton, _triton_mean),
    Backend("reference", always, lambda: reference.segment_mean),
)
MAX_BACKENDS = (
    Backend("graph", can_run_graph, lambda: graph.segment_max),
    Backend("triton", can_run_triton, _triton_max),
    Backend("numba", can_run_numba, _numba_max),
    Backend("reference", always, lambda: reference.segment_max),
)


BEV_BACKENDS = (
    Backend("graph", can_run_graph, lambda: graph.scatter_bev),
    Backend("reference", always, lambda: reference.scatter_bev),
)


def segment_sum(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Add the rows of each segment.

    Args:
        values: ``(K, C)`` floating point.
        segment: ``(K,)`` int64 segment of each row, in any order, each in ``0 .. size - 1``.
        size: number of segments S.

    Returns:
        ``(S, C)``; zero where a segment has no row.

    Raises:
        BeamboxError: if a shape or type does not fit, or, on the CPU, a segment is out of range.
    """
    _check(values, segment, size)
    return choose("segment_sum", SUM_BACKENDS, values, segment)(values, segment, size)


def segment_mean(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Average the rows of each segment; arguments and errors as in :func:`segment_sum`."""
    _check(values, segment, size)
    return choose("segment_mean", MEAN_BACKENDS, values, segment)(values, segment, size)


def segment_max(values: Tensor, segment: Tensor, size: int) -> Tensor:
    """Take the largest value of each segment and column; arguments and errors as in :func:`segment_sum`.

    The gradient goes to one row: the first of those that hold the maximum, on every backend. A NaN counts as larger
    than any number, so it is seen rather than skipped. Zero where a segment has no row.
    """
    _check(values, segment, size)
    return choose("segment_max", MAX_BACKENDS, values, segment)(values, segment, size)


def scatter_bev(features: Tensor, index: Tensor, batch_size: int, size: tuple[int, int]) -> Tensor:
    """Lay voxel features onto a bird's-eye-view map; voxels above each other are added.

    Args:
        features: ``(V, C)``.
        index: ``(V, 4)`` int64 (sample, z, y, x).
        batch_size: number of samples B.
        size: (ny, nx) cells of the map.

    Returns:
        ``(B, C, ny, nx)``, zero where no voxel is; laid out channels last, as convolutions like it.

    Raises:
        BeamboxError: if a shape or type does not fit, or, on the CPU, an index leaves the map.
    """
    _check_bev(features, index, batch_size, size)
    return choose("scatter_bev", BEV_BACKENDS, features, index)(features, index, batch_size, size)


def _check(values: Tensor, segment: Tensor, size: int) -> None:
    if exporting():  # asking for a length would fix it in the graph
        return
    expect_shape("values", values, (None, None))
    if not values.is_floating_point():
        raise BeamboxError(f"`values` must be floating point, got {str(values.dtype).removeprefix('torch.')}")
    expect_shape("segment", segment, (None,))
    expect_dtype("segment", segment, torch.int64)
    expect_same_length(values=len(values), segment=len(segment))
    if len(segment) and not waiting_is_dear(segment):  # a GPU would have to be waited for
        low, high = (int(value) for value in segment.aminmax())
        if low < 0 or high >= size:
            raise BeamboxError(f"`segment` must lie in 0 .. {size - 1} (size {size}), got {low} .. {high}")


def _check_bev(features: Tensor, index: Tensor, batch_size: int, size: tuple[int, int]) -> None:
    if exporting():  # asking for a length would fix it in the graph
        return
    expect_shape("features", features, (None, None))
    expect_shape("index", index, (len(features), 4))
    expect_dtype("index", index, torch.int64)
    ny, nx = size
    if len(index) and not waiting_is_dear(index):  # a GPU would have to be waited for
        low, high = index.amin(0).tolist(), index.amax(0).tolist()
        if min(low) < 0 or high[0] >= batch_size or high[2] >= ny or high[3] >= nx:
            raise BeamboxError(
                f"`index` (sample, z, y, x) must lie below ({batch_size}, any, {ny}, {nx}) and not below 0, "
                f"got {tuple(low)} .. {tuple(high)}"
            )
