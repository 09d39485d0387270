"""The sparse tensor: features at the active sites of a batch of voxel grids."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from beambox.checks import BeamboxError
from beambox.ops.dispatch import exporting
from beambox.ops.sparse_conv import graph_indices
from beambox.ops.sparse_conv.sites import Sites, Triple

__all__ = ["SparseTensor"]


@dataclass(frozen=True)
class SparseTensor:
    """Features at active sites; every other site of the grid is zero."""

    features: Tensor
    """``(V, C)``, one row a site."""
    sites: Sites
    """The ``V`` active sites, shared by tensors that differ only in their features."""

    def __post_init__(self) -> None:
        if exporting():  # asking for a length would fix it in the graph
            return
        if self.features.dim() != 2 or len(self.features) != len(self.sites):
            raise BeamboxError(
                f"`features` must have shape ({len(self.sites)}, C), one row a site, got {tuple(self.features.shape)}"
            )

    @classmethod
    def of(cls, features: Tensor, indices: Tensor, shape: Triple, batch_size: int) -> SparseTensor:
        """Build from features and their sites.

        Args:
            features: ``(V, C)``.
            indices: ``(V, 4)`` integers (b, z, y, x).
            shape: spatial extent (z, y, x) in cells.
            batch_size: number of samples; some may be empty.

        Raises:
            BeamboxError: for an index outside the grid or one that occurs twice.
        """
        return cls(features, Sites.of(indices, shape, batch_size))

    @property
    def indices(self) -> Tensor:
        """``(V, 4)`` int64 (b, z, y, x)."""
        return self.sites.indices

    @property
    def shape(self) -> Triple:
        """Spatial extent (z, y, x) in cells."""
        return self.sites.shape

    @property
    def batch_size(self) -> int:
        """Number of samples."""
        return self.sites.batch_size

    @property
    def channels(self) -> int:
        """Number of features a site."""
        return self.features.shape[1]

    def with_features(self, features: Tensor) -> SparseTensor:
        """Return other features at the same sites."""
        return SparseTensor(features, self.sites)

    def sorted(self) -> SparseTensor:
        """Return the same tensor with its sites in ascending (b, z, y, x) order, which makes gathering local."""
        sites = self.sites
        ascending = Sites.from_keys(sites.sorted_keys, sites.shape, sites.batch_size)
        if exporting():
            ascending.__dict__["indices"] = sites.indices[sites.order]  # as in Sites.trusted
        return SparseTensor(self.features[sites.order], ascending)

    def to_dense(self) -> Tensor:
        """Return ``(B, C, Z, Y, X)`` with zeros at the sites that are not active."""
        z, y, x = self.shape
        dense = self.features.new_zeros((self.batch_size, z, y, x, self.channels))
        dense.index_put_(tuple(self.indices.unbind(dim=1)), self.features)
        return dense.permute(0, 4, 1, 2, 3)  # (B, C, Z, Y, X)

    def to_bev(self) -> Tensor:
        """Stack the height levels into channels: ``(B, C * Z, Y, X)``, channel ``c * Z + z`` (VoxelNet, 2.1.3)."""
        if exporting():
            return graph_indices.to_bev(self.features, self.indices, self.shape, self.batch_size)
        z, y, x = self.shape
        b, level, row, column = self.indices.unbind(dim=1)
        bev = self.features.new_zeros((self.batch_size, y, x, self.channels, z))
        bev.transpose(3, 4).index_put_((b, row, column, level), self.features)  # (B, Y, X, Z, C) written through
        return bev.flatten(3).permute(0, 3, 1, 2)  # (B, C * Z, Y, X), channels last in memory
