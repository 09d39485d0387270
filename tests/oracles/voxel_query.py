"""Voxel query by plain loops."""

from __future__ import annotations

import numpy as np

from beambox.ops.sparse_conv import Sites


def query_by_loops(points, cells, sites: Sites, centres, reach, radius: float, samples: int) -> np.ndarray:
    """Visit the cells around each point in the published order; see ``beambox.ops.voxel_query``."""
    rows = {tuple(index): row for row, index in enumerate(sites.indices.tolist())}
    found = np.full((len(points), samples), -1)
    for i, (b, z, y, x) in enumerate(cells.tolist()):
        hits = []
        for dz in range(-reach[0], reach[0] + 1):
            for dy in range(-reach[1], reach[1] + 1):
                for dx in range(-reach[2], reach[2] + 1):
                    row = rows.get((b, z + dz, y + dy, x + dx))
                    if row is not None and float(((centres[row] - points[i]) ** 2).sum()) <= radius**2:
                        hits.append(row)
        if hits:
            hits = hits[:samples]
            found[i] = hits + [hits[0]] * (samples - len(hits))
    return found
