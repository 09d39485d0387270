"""Point Cloud Library files (.pcd): ascii, binary and binary_compressed, through pypcd4."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode, library

__all__ = ["read_pcd"]


def read_pcd(path: Path) -> Columns:
    """Read a PCD file; organised clouds are flattened, padding fields (``_``) left out.

    Raises:
        BeamboxError: if pypcd4 is absent, or the file is damaged or cut short.
    """
    pypcd4 = library("pypcd4", path)

    def read() -> Columns:
        with path.open("rb") as stream:
            cloud = pypcd4.PointCloud.from_fileobj(stream)
        data = np.atleast_1d(cloud.pc_data)
        if len(data) != cloud.metadata.points:
            raise BeamboxError(
                f"{path} is cut short: its header promises {cloud.metadata.points} points, it holds {len(data)}"
            )
        names = tuple(name for name in data.dtype.names or () if name.isprintable() and name[0] not in "#_")
        return Columns(names, [data[name] for name in names])

    return decode(path, "PCD file", read)
