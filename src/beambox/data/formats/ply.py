"""Polygon files (.ply), ascii and binary, through plyfile: the points are the vertices."""

from __future__ import annotations

from pathlib import Path

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode, library

__all__ = ["read_ply"]


def read_ply(path: Path) -> Columns:
    """Read the vertices of a PLY file; list properties are left out.

    Raises:
        BeamboxError: if plyfile is absent, or the file is damaged, cut short or has no vertices.
    """
    plyfile = library("plyfile", path)

    def read() -> Columns:
        with path.open("rb") as stream:
            parsed = plyfile.PlyData.read(stream, mmap=False)
        elements = [element for element in parsed.elements if element.name == "vertex"]
        if not elements:
            found = ", ".join(element.name for element in parsed.elements) or "nothing"
            raise BeamboxError(f"{path} must have the element `vertex`, got {found}")
        data = elements[0].data
        names = tuple(name for name in data.dtype.names or () if data.dtype[name].kind in "fiu")
        return Columns(names, [data[name] for name in names])

    return decode(path, "PLY file", read)
