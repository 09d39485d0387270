"""Voxel query: the active voxels near a point, found by their indices rather than by distance to all."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor

from beambox.checks import BeamboxError, expect_same_length, expect_shape
from beambox.ops.dispatch import Backend, always, can_run_numba, can_run_triton, choose, needs_gradient
from beambox.ops.sparse_conv import Sites, Triple
from beambox.ops.voxel_query import reference
from beambox.ops.voxel_query.reference import pooled

__all__ = ["pooled", "pooled_query", "voxel_query"]


def _numba() -> Callable[..., Tensor]:
    from beambox.ops.voxel_query.cpu import voxel_query

    return voxel_query


def _triton() -> Callable[..., Tensor]:
    from beambox.ops.voxel_query.gpu import voxel_query

    return voxel_query


def _numba_pooled() -> Callable[..., Tensor]:
    from beambox.ops.voxel_query.cpu import pooled_query

    return pooled_query


def _triton_pooled() -> Callable[..., Tensor]:
    return partial(reference.pooled_query, search=_triton())


POOLED_BACKENDS = (
    Backend("triton", can_run_triton, _triton_pooled),
    Backend("numba", can_run_numba, _numba_pooled),
    Backend("reference", always, lambda: reference.pooled_query),
)
BACKENDS = (
    Backend("triton", can_run_triton, _triton),
    Backend("numba", can_run_numba, _numba),
    Backend("reference", always, lambda: reference.voxel_query),
)


def voxel_query(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float, max_samples: int
) -> Tensor:
    """Find the first active voxels around each point (Voxel R-CNN, section 3.2).

    The cells within ``query_range`` of a point's own cell are visited with x fastest, then y, then z; an active one
    whose centre is no farther than ``radius`` from the point is taken, until there are ``max_samples``. No gradient.

    Args:
        points: ``(M, 3)`` x, y, z in metres.
        cells: ``(M, 4)`` int64 (b, z, y, x) of the cell each point lies in; may lie outside the grid.
        sites: the active voxels.
        centers: ``(V, 3)`` x, y, z of the voxels' centres in metres.
        query_range: cells looked at on both sides (z, y, x).
        radius: metres.
        max_samples: number of voxels S.

    Returns:
        ``(M, S)`` int64 rows of ``sites``; where fewer are found the first is repeated, where none is all are -1.

    Raises:
        BeamboxError: if a shape does not fit, or a limit is not positive.
    """
    _check(points, cells, sites, centers, query_range, radius, max_samples)
    points, centers = points.detach(), centers.detach().to(points.dtype)
    return choose("voxel_query", BACKENDS, points, cells)(
        points, cells, sites, centers, query_range, radius, max_samples
    )


def pooled_query(
    points: Tensor,
    cells: Tensor,
    sites: Sites,
    centers: Tensor,
    query_range: Triple,
    radius: float,
    max_samples: int,
    features: Tensor,
    weight: Tensor,
    bias: Tensor,
) -> Tensor:
    """Find voxels as :func:`voxel_query` does and pool them at once, for inference on a CPU.

    ``relu(max over the voxels v found of features[v] + weight @ (center[v] - point) + bias)``; ``relu(bias)`` where
    none is found.

    Args:
        points: ``(M, 3)`` x, y, z in metres.
        cells: ``(M, 4)`` int64 (b, z, y, x) of the cell each point lies in.
        sites: the active voxels.
        centers: ``(V, 3)`` x, y, z of the voxels' centres in metres.
        query_range: cells looked at on both sides (z, y, x).
        radius: metres.
        max_samples: number of voxels at most.
        features: ``(V, C)`` float32.
        weight: ``(C, 3)`` float32.
        bias: ``(C,)`` float32.

    Returns:
        ``(M, C)``.

    Raises:
        BeamboxError: if a shape does not fit, or a limit is not positive.
    """
    _check(points, cells, sites, centers, query_range, radius, max_samples)
    expect_shape("features", features, (len(sites), len(bias)))
    expect_shape("weight", weight, (len(bias), 3))
    pooling = POOLED_BACKENDS[-1:] if needs_gradient(features, weight, bias) else POOLED_BACKENDS
    run = choose("pooled_query", pooling, points, cells, features, weight, bias)
    return run(points, cells, sites, centers.to(points.dtype), query_range, radius, max_samples, features, weight, bias)


def _check(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float, max_samples: int
) -> None:
    expect_shape("points", points, ("M", 3))
    expect_shape("cells", cells, ("M", 4))
    expect_shape("centers", centers, (len(sites), 3))
    expect_same_length(points=len(points), cells=len(cells))
    if min(query_range) < 0 or not radius > 0 or max_samples < 1:
        raise BeamboxError(
            f"a voxel query needs a reach of at least 0, a positive radius and at least 1 sample, "
            f"got {query_range}, {radius} and {max_samples}"
        )
