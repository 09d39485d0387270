"""From voxels to a bird's-eye-view map: the 3-D backbone of SECOND and of its successors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from beambox.geometry.constants import constant
from beambox.layers.sparse import levels_left, sparse_block, submanifold_block
from beambox.ops.scatter import segment_mean
from beambox.ops.sparse_conv import Sites, SparseTensor, find_chain
from beambox.ops.voxelize import Voxels

__all__ = ["EncoderStages", "VoxelEncoder", "mean_voxels"]


def mean_voxels(voxels: Voxels, absolute_xy: bool = True) -> SparseTensor:
    """Describe each voxel by the mean of its kept points, in ascending (b, z, y, x) order.

    The height is one level larger than the grid's (SECOND's published code), so that 40 levels shrink to 2.

    Args:
        voxels: of the points.
        absolute_xy: whether x and y are metres from the sensor; else they are cells from the voxel's centre, so that a
            network sees the same wherever it looks.
    """
    means = segment_mean(voxels.points, voxels.voxel, voxels.index.shape[0])  # (V, C)
    if not absolute_xy:
        cell = constant(voxels.grid.cell[:2], means.device)
        offset = (means[:, :2] - voxels.grid.center(voxels.index[:, 1:])[:, :2]) / cell
        means = torch.cat((offset.to(means.dtype), means[:, 2:]), dim=1)
    nz, ny, nx = voxels.grid.shape
    sites = Sites.trusted(voxels.index, (nz + 1, ny, nx), voxels.batch_size)
    return SparseTensor(means, sites).sorted()


@dataclass(frozen=True)
class EncoderStages:
    """Outputs of the encoder: sparse features at rising strides, and the map."""

    stride2: SparseTensor
    """After the second stage; cells of 2 voxels."""
    stride4: SparseTensor
    """After the third stage; cells of 4 voxels."""
    stride8: SparseTensor
    """After the fourth stage; cells of 8 voxels."""
    bev: Tensor
    """``(B, C, Y / 8, X / 8)`` height levels stacked into channels."""


class VoxelEncoder(nn.Module):
    """Four stages of sparse convolutions, each but the first halving the resolution, and one that halves the height.

    ==========  =========================================================  ======
    stage       layers (kernel 3 unless said; padding and stride z, y, x)  stride
    ==========  =========================================================  ======
    stem        submanifold C -> w0                                        1
    stage 1     submanifold w0 -> w0                                       1
    stage 2     strided w0 -> w1, 2 submanifold                            2
    stage 3     strided w1 -> w2, 2 submanifold                            4
    stage 4     strided w2 -> w3 padding (0, 1, 1), 2 submanifold          8
    out         strided w3 -> out, kernel (3, 1, 1), stride (2, 1, 1)      8
    ==========  =========================================================  ======

    Every convolution is bias-free and followed by batch norm and ReLU (SECOND, section 3.1.2, as in the public
    toolbox's eightfold backbone).
    """

    def __init__(self, in_channels: int, widths: Sequence[int] = (16, 32, 64, 64), out_channels: int = 128) -> None:
        super().__init__()
        w0, w1, w2, w3 = widths
        self.stem = submanifold_block(in_channels, w0)
        self.stage1 = nn.Sequential(submanifold_block(w0, w0))
        self.stage2 = _stage(w0, w1, (1, 1, 1))
        self.stage3 = _stage(w1, w2, (1, 1, 1))
        self.stage4 = _stage(w2, w3, (0, 1, 1))
        self.out = sparse_block(w3, out_channels, (3, 1, 1), (2, 1, 1), 0)
        self.out_channels = out_channels
        self.stage_channels = (w1, w2, w3)

    def bev_channels(self, levels: int) -> int:
        """Return the map's channels for a grid of so many height levels: those left times ``out_channels``.

        Raises:
            BeamboxError: for a grid too flat to be halved four times.
        """
        strided = (self.stage2[0], self.stage3[0], self.stage4[0], self.out)
        return self.out_channels * levels_left(strided, levels + 1)

    def forward(self, voxels: SparseTensor) -> EncoderStages:
        """Encode ``(V, in_channels)`` voxel features."""
        strided = (self.stage2[0], self.stage3[0], self.stage4[0], self.out)
        find_chain(voxels.sites, [block.conv.spec for block in strided])  # pyright: ignore
        with torch.autocast(voxels.features.device.type, enabled=False):  # metres: bfloat16 would round them to 0.5
            stem = self.stem(voxels)
        stride1 = self.stage1(stem)
        stride2 = self.stage2(stride1)
        stride4 = self.stage3(stride2)
        stride8 = self.stage4(stride4)
        return EncoderStages(stride2, stride4, stride8, self.out(stride8).to_bev())


def _stage(in_channels: int, channels: int, padding: tuple[int, int, int]) -> nn.Sequential:
    return nn.Sequential(
        sparse_block(in_channels, channels, 3, 2, padding),
        submanifold_block(channels, channels),
        submanifold_block(channels, channels),
    )
