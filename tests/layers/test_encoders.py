from __future__ import annotations

import pytest
import torch

from beambox.geometry.grid import VoxelGrid
from beambox.layers.encoders import VoxelEncoder, mean_voxels
from beambox.ops.voxelize import voxelize

GRID = VoxelGrid((64.0, -1.6, -3.0), (67.2, 1.6, 1.0), (0.1, 0.1, 0.1))


def test_far_voxels_look_the_same_in_mixed_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cpu._is_amx_tile_supported", lambda: True)  # else a CPU keeps float32 everywhere
    torch.manual_seed(0)
    steps, nil = torch.arange(10) * 0.3, torch.zeros(1)
    lattice = torch.cartesian_prod(steps, steps, nil, nil)  # so far apart that no voxel sees another
    points = lattice + torch.rand(100, 4) * 0.05 + torch.tensor([64.12, -1.48, -1.0, 0.0])
    voxels = mean_voxels(voxelize(points, torch.zeros(100, dtype=torch.int64), 1, GRID))
    stem = VoxelEncoder(4, (8, 8, 8, 8), 8).stem
    raw = stem.conv(voxels).features.detach()
    stem.norm.running_mean, stem.norm.running_var = raw.mean(dim=0), raw.var(dim=0)  # as trained here
    encoder = VoxelEncoder(4, (8, 8, 8, 8), 8).eval()
    encoder.stem = stem.eval()
    seen: list[torch.Tensor] = []
    encoder.stage1.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].features))
    encoder(voxels)
    with torch.autocast("cpu", torch.bfloat16):
        stages = encoder(voxels)
    exact, mixed = seen
    assert float(((mixed - exact).norm() / exact.norm()).detach()) < 0.01
    assert stages.bev.dtype == torch.bfloat16, "the layers after the first run in the lower precision"
