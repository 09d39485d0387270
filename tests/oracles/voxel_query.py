"""Voxel query by plain loops."""

from __future__ import annotations

import numpy as np

from beambox.ops.sparse_conv import Sites


def query_by_loops(points, cells, sites: Sites, centers, query_range, radius: float, max_samples: int) -> np.ndarray:
    """Visit the cells around each point in the published order; see ``beambox.ops.voxel_query``."""
    rows = {tuple(index): row for row, index in enumerate(sites.indices.tolist())}
    found = np.full((len(points), max_samples), -1)
    for i, (b, z, y, x) in enumerate(cells.tolist()):
        hits = []
        for dz in range(-query_range[0], query_range[0] + 1):
            for dy in range(-query_range[1], query_range[1] + 1):
                for dx in range(-query_range[2], query_range[2] + 1):
                    row = rows.get((b, z + dz, y + dy, x + dx))
                    if row is not None and float(((centers[row] - points[i]) ** 2).sum()) <= radius**2:
                        hits.append(row)
        if hits:
            hits = hits[:max_samples]
            found[i] = hits + [hits[0]] * (max_samples - len(hits))
    return found
