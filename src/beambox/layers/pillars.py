"""The pillar feature network: a small PointNet over the points of each cell (PointPillars, section 2.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from beambox.ops.scatter import segment_max, segment_mean
from beambox.ops.voxelize import Voxels

__all__ = ["PillarFeatures"]


class PillarFeatures(nn.Module):
    """Describe each point by its place in its cell, pass it through one linear layer, keep the maximum of each cell.

    Per point: x, y, z, intensity; offset from the mean of the cell's points (3); offset from the cell's centre (3).

    The published code pads every cell to a fixed number of points, lets the padding into the batch norm's statistics
    and, after ReLU, into the maximum. Here no padding exists and statistics are those of real points; with
    ``empty_slots`` set, a cell with fewer points than that contributes ReLU(BN(0)) to the maximum, which makes the two
    agree in evaluation mode.
    """

    def __init__(
        self, channels: int = 64, num_point_features: int = 4, absolute_xy: bool = True, empty_slots: int | None = None
    ) -> None:
        super().__init__()
        self.absolute_xy = absolute_xy
        self.empty_slots = empty_slots
        inputs = num_point_features + 6 - (0 if absolute_xy else 2)
        self.linear = nn.Linear(inputs, channels, bias=False)
        self.norm = nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)

    def forward(self, voxels: Voxels) -> Tensor:
        """Return one feature a cell, ``(V, channels)``, all at least 0."""
        xyz, size = voxels.points[:, :3], voxels.index.shape[0]
        mean = segment_mean(xyz, voxels.voxel, size)  # (V, 3)
        center = voxels.grid.center(voxels.index[:, 1:]).to(xyz.dtype)  # (V, 3)
        absolute = voxels.points if self.absolute_xy else voxels.points[:, 2:]
        described = torch.cat((absolute, xyz - mean[voxels.voxel], xyz - center[voxels.voxel]), dim=1)
        lifted = self.lift(described)  # (K, channels)
        if self.training and len(lifted) < 2:  # batch statistics need two values
            lifted = functional.batch_norm(
                lifted, self.norm.running_mean, self.norm.running_var, self.norm.weight, self.norm.bias, eps=1e-3
            )
        else:
            lifted = self.norm(lifted)
        features = segment_max(functional.relu(lifted), voxels.voxel, size)  # (V, channels)
        if self.empty_slots is None:
            return features
        of_zero = functional.batch_norm(
            features.new_zeros(1, features.shape[1]),
            self.norm.running_mean,
            self.norm.running_var,
            self.norm.weight,
            self.norm.bias,
            eps=self.norm.eps,
        )  # (1, channels): what an empty place gives
        padded = torch.maximum(features, functional.relu(of_zero))
        return torch.where((voxels.count < self.empty_slots)[:, None], padded, features)

    def lift(self, described: Tensor) -> Tensor:
        """Apply the linear layer, in float32 where it sees metres: at 70 m, bfloat16 knows only every half metre."""
        if not self.absolute_xy:
            return self.linear(described)
        with torch.autocast(described.device.type, enabled=False):
            return self.linear(described)
