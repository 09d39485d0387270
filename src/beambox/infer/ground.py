"""Show a network an empty sweep, so that it need not compute again what a sweep leaves as it is."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from beambox.geometry import VoxelGrid
from beambox.ops.map_conv import learning_ground
from beambox.structures import Batch, Frame

__all__ = ["EmptyGround"]


class EmptyGround:
    """Remembers for which weights and region a network has seen an empty sweep."""

    def __init__(self) -> None:
        self._learnt: tuple[Any, ...] | None = None
        self._met: tuple[Any, ...] | None = None
        self._weights: list[nn.Parameter] = []

    def learn(self, model: nn.Module, grid: VoxelGrid) -> None:
        """Let a network see an empty sweep before its second real one, and again once weights or region have changed.

        Not before the first, as often there is no second. Only on a CPU in float32: elsewhere all cells are computed.
        """
        weights = self._weights = self._weights or list(model.parameters())  # walking the layers takes milliseconds
        if not weights or weights[0].device.type != "cpu" or torch.is_autocast_enabled("cpu"):
            return
        if any(weight.is_inference() for weight in weights):  # they do not count their changes
            return
        state = (grid, *(n for weight in weights for n in (weight.data_ptr(), weight._version)))
        if self._met != state:
            self._met = state
        elif self._learnt != state:
            columns = getattr(model, "config").num_point_features  # noqa: B009
            with learning_ground():
                model(Batch.of([Frame(torch.zeros(0, columns))]), grid)
            self._learnt = state

    def learnt(self) -> bool:
        """Tell whether the last pass knew empty ground."""
        return self._met is not None and self._learnt == self._met
