"""Survey files (.las, compressed .laz), through laspy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beambox.data.formats.columns import Columns, decode, library

__all__ = ["read_las"]


def read_las(path: Path) -> Columns:
    """Read a LAS or LAZ file: x, y, z with the header's scale and offset applied, and every plain dimension.

    Raises:
        BeamboxError: if laspy is absent, or the file is damaged or cut short.
    """
    laspy = library("laspy", path)

    def read() -> Columns:
        cloud = laspy.read(str(path))
        names = ["x", "y", "z"]
        arrays = [np.asarray(cloud.x), np.asarray(cloud.y), np.asarray(cloud.z)]
        for name in cloud.point_format.dimension_names:
            array = np.asarray(cloud[name])
            if name not in ("X", "Y", "Z") and array.ndim == 1 and array.dtype.kind in "fiu":
                names.append(name)
                arrays.append(array)
        return Columns(tuple(names), arrays)

    return decode(path, "LAS file", read)
