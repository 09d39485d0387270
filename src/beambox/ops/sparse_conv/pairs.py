"""A kernel map as a table of rows, the form that the reference and the GPU work on."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from beambox.ops.dispatch import Backend, always, can_run_graph, can_run_triton, choose
from beambox.ops.sparse_conv import reference_maps
from beambox.ops.sparse_conv.sites import KernelMap

__all__ = ["input_rows"]


def _triton_table() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.gpu_maps import neighbor_table

    return neighbor_table


def _triton_inverse() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.gpu_maps import inverse_table

    return inverse_table


def _graph_table() -> Callable[..., Tensor]:
    from beambox.ops.sparse_conv.graph_maps import neighbor_table

    return neighbor_table


TABLE_BACKENDS = (
    Backend("graph", can_run_graph, _graph_table),
    Backend("triton", can_run_triton, _triton_table),
    Backend("reference", always, lambda: reference_maps.neighbor_table),
)
INVERSE_BACKENDS = (
    Backend("triton", can_run_triton, _triton_inverse),
    Backend("reference", always, lambda: reference_maps.inverse_table),
)


def input_rows(pairs: KernelMap) -> Tensor:
    """Build ``(V_out, K)`` int32: the row of the input site that reaches an output through an offset, or -1.

    To be kept with the map: ``pairs.kept(input_rows)``.
    """
    if pairs.inverse_of is None:
        look_up = choose("neighbor_table", TABLE_BACKENDS, pairs.source.sorted_keys)
        return look_up(pairs.source, pairs.target, pairs.spec)
    forward = pairs.inverse_of.kept(input_rows)
    if pairs.spec.submanifold:
        return forward.flip(1).contiguous()  # a centred kernel mirrors itself
    return choose("inverse_table", INVERSE_BACKENDS, forward)(forward, len(pairs.target))
