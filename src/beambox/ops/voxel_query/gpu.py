"""Voxel query on a GPU (Triton): a program owns a block of points and walks the lines of cells around each."""
# pyright: reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from beambox.geometry.constants import constant
from beambox.ops.sparse_conv import Sites, Triple

__all__ = ["voxel_query"]

BLOCK = 64


def voxel_query(
    points: Tensor, cells: Tensor, sites: Sites, centers: Tensor, query_range: Triple, radius: float, max_samples: int
) -> Tensor:
    """Find the first active voxels around each point; see :func:`beambox.ops.voxel_query.voxel_query`."""
    found = torch.full((len(points), max_samples), -1, dtype=torch.int64, device=points.device)
    if len(sites) == 0 or len(points) == 0:
        return found
    limit = constant((radius,), points.device, points.dtype) ** 2  # rounded as the reference rounds
    _search[(triton.cdiv(len(points), BLOCK),)](
        points.contiguous(), cells.contiguous(), centers.contiguous(), sites.sorted_keys, sites.order, found, limit,
        len(points), len(sites), len(sites).bit_length(), sites.batch_size, *sites.shape, *query_range, max_samples,
        BLOCK, enable_fp_fusion=False,
    )  # fmt: skip
    return found


@triton.jit
def _search(  # noqa: PLR0913, PLR0917 - kernels take sizes one by one
    points, cells, centers, keys, order, found, limit, count, sites, steps, nb, nz, ny, nx, rz, ry, rx, max_samples,
    block: tl.constexpr,
):  # fmt: skip
    """Write the rows found by one block of points."""
    at = tl.program_id(0) * block + tl.arange(0, block)
    has = at < count
    b, z = tl.load(cells + at * 4, has, -1), tl.load(cells + at * 4 + 1, has, 0)
    y, x = tl.load(cells + at * 4 + 2, has, 0), tl.load(cells + at * 4 + 3, has, 0)
    # Out of reach of the grid; the indices may be any, so nothing may be added to them before this is known.
    has = has & (b >= 0) & (b < nb) & (z >= -rz) & (y >= -ry) & (x >= -rx)
    has = has & (z - nz < rz) & (y - ny < ry) & (x - nx < rx)
    z, y, x = tl.where(has, z, 0), tl.where(has, y, 0), tl.where(has, x, 0)
    px, py = tl.load(points + at * 3, has, 0.0), tl.load(points + at * 3 + 1, has, 0.0)
    pz, query_range = tl.load(points + at * 3 + 2, has, 0.0), tl.load(limit)
    n = tl.zeros((block,), tl.int32)
    first = tl.zeros((block,), tl.int64) - 1
    for line in range((2 * rz + 1) * (2 * ry + 1)):
        cz, cy = z + line // (2 * ry + 1) - rz, y + line % (2 * ry + 1) - ry
        open_ = has & (n < max_samples) & (cz >= 0) & (cz < nz) & (cy >= 0) & (cy < ny)
        if tl.max(open_.to(tl.int32), axis=0) > 0:
            start = ((b * nz + cz) * ny + cy) * nx
            wanted = start + tl.maximum(x - rx, 0)  # the line's first cell within reach
            last = start + tl.minimum(x + rx, nx - 1)
            low = tl.zeros((block,), tl.int64)
            high = low + sites
            for _ in range(steps):
                middle = (low + high) // 2
                smaller = tl.load(keys + middle, open_ & (middle < sites), 0) < wanted
                low = tl.where(smaller & (low < high), middle + 1, low)
                high = tl.where(smaller, high, middle)
            for step in range(2 * rx + 1):  # an active cell of the line a step
                here = open_ & (low + step < sites) & (n < max_samples)
                here = here & (tl.load(keys + low + step, here, 0x7FFFFFFFFFFFFFFF) <= last)
                row = tl.load(order + low + step, here, 0)
                dx = tl.load(centers + row * 3, here, 0.0) - px
                dy = tl.load(centers + row * 3 + 1, here, 0.0) - py
                dz = tl.load(centers + row * 3 + 2, here, 0.0) - pz
                hit = here & (dx * dx + dy * dy + dz * dz <= query_range)
                tl.store(found + at * max_samples + n, row, hit)
                first = tl.where(hit & (n == 0), row, first)
                n += hit.to(tl.int32)
    for k in range(max_samples):
        tl.store(found + at * max_samples + k, first, has & (k >= n) & (n > 0))
