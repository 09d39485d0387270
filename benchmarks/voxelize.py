"""How long voxelization of one sweep takes in numba and in the reference; python benchmarks/voxelize.py [SCAN.bin]."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import torch
from timing import shortest
from torch import Tensor

from beambox.geometry.grid import VoxelGrid
from beambox.ops.voxelize import cpu, reference

GRIDS = {
    "pillars 0.16 m": VoxelGrid((0, -39.68, -3), (69.12, 39.68, 1), (0.16, 0.16, 4)),
    "voxels 0.1 x 0.1 x 0.15 m": VoxelGrid((0, -40, -3), (70.4, 40, 3), (0.1, 0.1, 0.15)),
    "voxels 0.05 x 0.05 x 0.1 m": VoxelGrid((0, -40, -3), (70.4, 40, 1), (0.05, 0.05, 0.1)),
}


def sweep(count: int, generator: torch.Generator) -> Tensor:
    """Return (count, 4) points, dense near the sensor, 90 degrees wide."""
    r, angle, z, intensity = torch.rand(4, count, generator=generator)
    r, angle = 2 + 68 * r**2, (angle - 0.5) * math.pi / 2
    return torch.stack((r * angle.cos(), r * angle.sin(), z * 3 - 2.5, intensity), dim=1)


def main() -> None:
    if len(sys.argv) > 1:
        points = torch.from_numpy(np.fromfile(Path(sys.argv[1]), np.float32).reshape(-1, 4))
    else:
        points = sweep(20_000, torch.Generator().manual_seed(0))
    sample = torch.zeros(len(points), dtype=torch.int64)
    print(f"{len(points)} points, {torch.get_num_threads()} threads; the shortest of several runs")
    print(f"{'grid':28} {'voxels':>7} {'reference':>12} {'numba':>10} {'ratio':>7}")
    for name, grid in GRIDS.items():
        count = len(cpu.voxelize(points, sample, 1, grid, 32, 40_000))
        slow = shortest(lambda: reference.voxelize(points, sample, 1, grid, 32, 40_000))  # noqa: B023
        fast = shortest(lambda: cpu.voxelize(points, sample, 1, grid, 32, 40_000))  # noqa: B023
        print(f"{name:28} {count:7} {slow * 1e3:9.2f} ms {fast * 1e3:7.2f} ms {slow / fast:6.1f}x")


if __name__ == "__main__":
    main()
