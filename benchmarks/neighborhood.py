"""Neighbourhood attention and ball counts timed beside one 3 x 3 convolution; python benchmarks/neighborhood.py."""

from __future__ import annotations

import torch
from timing import memory_added, shortest
from torch import Tensor

from beambox.geometry.grid import VoxelGrid
from beambox.ops.ball_count import cpu as ball_count
from beambox.ops.neighborhood import cpu as attention
from beambox.ops.voxelize import cpu as voxelize


def density_voxels(count: int, generator: torch.Generator) -> Tensor:
    """Return at most ``count`` voxels of 0.1 x 0.1 x 0.15 m, dense near the sensor, mostly near the ground."""
    r, angle, z = torch.rand(3, 2 * count, generator=generator)
    r, angle = 2 + 60 * r**1.5, (angle - 0.5) * torch.pi / 2
    points = torch.stack((r * angle.cos(), r * angle.sin(), -1.7 + 2 * z**4), dim=1)
    grid = VoxelGrid((0, -40, -3), (70.4, 40, 3), (0.1, 0.1, 0.15))
    sample = torch.zeros(len(points), dtype=torch.int64)
    return voxelize.voxelize(points, sample, 1, grid, max_voxels=count).index


def maps_added(side: int = 188) -> float:
    """Return by how many maps as large as K the process grows in a forward and backward pass, inputs included."""

    def run(size: int) -> None:
        q, k, v = (torch.randn(1, 2, size, size, 32, requires_grad=True) for _ in range(3))
        bias = torch.zeros(2, 13, 13, requires_grad=True)
        attention.neighborhood_attention(q, k, v, bias).sum().backward()

    run(7)  # compiles
    return memory_added(lambda: run(side)) / (4 * 64 * side**2)


def main() -> None:
    print(f"memory: inputs, output, gradients add {maps_added():.0f} maps of K; copies for 49 neighbours would add 98")
    generator = torch.Generator().manual_seed(0)
    print(f"{torch.get_num_threads()} threads; the shortest of several runs")
    q, k, v = (torch.randn(1, 2, 188, 188, 32, generator=generator).requires_grad_() for _ in range(3))
    bias = torch.zeros(2, 13, 13, requires_grad=True)
    image = torch.randn(1, 64, 188, 188, generator=generator, requires_grad=True)
    convolution = torch.nn.Conv2d(64, 64, 3, padding=1)
    with torch.no_grad():
        plain = 1e3 * shortest(lambda: convolution(image))
        ours = 1e3 * shortest(lambda: attention.neighborhood_attention(q, k, v, bias))
    print(f"forward, 188 x 188 x 64:  convolution {plain:7.1f} ms, attention {ours:7.1f} ms, {ours / plain:.1f} times")
    plain = 1e3 * shortest(lambda: convolution(image).sum().backward(), 5)
    ours = 1e3 * shortest(lambda: attention.neighborhood_attention(q, k, v, bias).sum().backward(), 5)
    print(f"and backward:             convolution {plain:7.1f} ms, attention {ours:7.1f} ms, {ours / plain:.1f} times")
    index = density_voxels(30_000, generator)
    for radius in (0.6, 1.8):
        taken = 1e3 * shortest(lambda: ball_count.ball_count(index, (0.1, 0.1, 0.15), radius))  # noqa: B023
        print(f"ball_count, {len(index)} voxels, {radius} m: {taken:.1f} ms")


if __name__ == "__main__":
    main()
