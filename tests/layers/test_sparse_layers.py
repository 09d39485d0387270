"""Sparse layers and the encoder: folding, statistics, sizes."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from beambox.checks import BeamboxError
from beambox.geometry.grid import VoxelGrid
from beambox.layers.encoders import VoxelEncoder, mean_voxels
from beambox.layers.sparse import InverseConv3d, SparseConv3d, sparse_block, submanifold_block
from beambox.ops.sparse_conv import SparseTensor
from beambox.ops.voxelize import voxelize
from oracles.sparse_conv import dense_weight, random_sparse, read_at


def block_with_statistics(block):
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for values in (block.norm.weight, block.norm.bias, block.norm.running_mean, block.norm.running_var):
            values.copy_(torch.rand(values.shape, generator=generator) + 0.1)
    return block


@pytest.mark.parametrize("make", [lambda: submanifold_block(3, 5), lambda: sparse_block(3, 5, 3, 2, 1)])
def test_folded_block_equals_convolution_norm_relu(make):
    block = block_with_statistics(make()).double().eval()
    x = random_sparse(1)
    plain = block.conv(x)
    expected = F.relu(block.norm(plain.features))
    torch.testing.assert_close(block(x).features, expected, rtol=1e-10, atol=1e-10)


def test_block_in_training_normalizes_over_active_sites():
    block = submanifold_block(3, 5).double()
    out = block(random_sparse(2)).features
    plain = block.conv(random_sparse(2)).features
    expected = F.relu((plain - plain.mean(0)) / torch.sqrt(plain.var(0, unbiased=False) + 1e-3))
    torch.testing.assert_close(out, expected)
    assert int(block.norm.num_batches_tracked) == 1


@pytest.mark.parametrize("sites", [0, 1])
@pytest.mark.parametrize("training", [True, False])
def test_block_survives_almost_nothing(sites, training):
    block = submanifold_block(3, 16).train(training)
    x = SparseTensor.of(torch.ones(sites, 3), torch.zeros(sites, 4, dtype=torch.int64), (4, 4, 4), 1)
    out = block(x)
    assert out.features.shape == (sites, 16)
    out.features.sum().backward()
    assert block.conv.weight.grad is not None


def test_inverse_layer_returns_to_the_fine_sites():
    down, up = SparseConv3d(3, 4, 3, 2, 1).double(), InverseConv3d(4, 2, 3, 2, 1).double()
    fine = random_sparse(3)
    out = up(down(fine), fine.sites)
    assert out.sites is fine.sites
    assert out.channels == 2


def test_encoder_equals_dense_convolutions_where_everything_is_active():
    torch.manual_seed(0)
    encoder = VoxelEncoder(2, (3, 4, 5, 6), 7).double().eval()
    for module in encoder.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            block_with_statistics(type("Block", (), {"norm": module})())
    x = random_sparse(4, (28, 8, 16), 2, 1.0, 2)

    def dense(block, value):
        spec, norm = block.conv.spec, block.norm
        value = F.conv3d(value, dense_weight(block.conv.kernel()), None, spec.stride, spec.padding)
        return F.relu(F.batch_norm(value, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps))

    value = x.to_dense()
    levels = []
    for stage in (encoder.stem, encoder.stage1, encoder.stage2, encoder.stage3, encoder.stage4, encoder.out):
        for block in stage if isinstance(stage, torch.nn.Sequential) else [stage]:
            value = dense(block, value)
        levels.append(value)
    stages = encoder(x)
    for ours, expected in zip((stages.stride2, stages.stride4, stages.stride8), levels[2:5]):
        torch.testing.assert_close(ours.features, read_at(expected, ours.indices))
    torch.testing.assert_close(stages.bev, levels[5].flatten(1, 2))
    assert stages.bev.shape[1] == encoder.bev_channels(27)


@pytest.mark.parametrize(("levels", "channels"), [(40, 256), (27, 128), (26, 128)])
def test_map_channels_follow_from_the_height(levels, channels):
    assert VoxelEncoder(4).bev_channels(levels) == channels


def test_a_grid_too_flat_is_refused():
    with pytest.raises(BeamboxError, match="does not fit an input"):
        VoxelEncoder(4).bev_channels(8)


@pytest.mark.parametrize("absolute", [True, False])
def test_mean_voxels_tell_where_the_points_are(absolute):
    grid = VoxelGrid((0.0, -2.0, -1.0), (4.0, 2.0, 1.0), (0.5, 0.5, 0.5))
    points = torch.tensor([[3.1, 1.2, 0.1, 0.5], [3.3, 1.4, 0.3, 0.7], [0.6, -1.9, -0.9, 0.0]])
    voxels = voxelize(points, torch.zeros(3, dtype=torch.int64), 1, grid)
    described = mean_voxels(voxels, absolute)
    assert described.indices.tolist() == [[0, 0, 0, 1], [0, 2, 6, 6]]
    assert described.shape == (5, 8, 8)
    first = [0.6, -1.9, -0.9, 0.0] if absolute else [-0.3, -0.3, -0.9, 0.0]
    second = [3.2, 1.3, 0.2, 0.6] if absolute else [-0.1, 0.1, 0.2, 0.6]
    torch.testing.assert_close(described.features, torch.tensor([first, second]))
