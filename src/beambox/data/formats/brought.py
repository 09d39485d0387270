"""Readers of other installed packages: entry points of the group ``beambox.readers``, see docs/add_reader.md."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode

__all__ = ["brought_reader", "brought_suffixes"]

GROUP = "beambox.readers"


def brought_suffixes() -> tuple[str, ...]:
    """Return the endings that installed packages read, in lower case with their dot; imports none of them."""
    return tuple(_entries())


def brought_reader(suffix: str) -> Callable[[Path], Columns] | None:
    """Return the reader that an installed package brings for an ending, importing it; None where there is none.

    Args:
        suffix: in lower case with its dot.

    Raises:
        BeamboxError: by the reader, for files that it cannot read and for anything but :class:`Columns`.
    """
    entry = _entries().get(suffix)
    if entry is None:
        return None

    def read(path: Path) -> Columns:
        try:
            function = entry.load()
        except Exception as error:  # whatever a package raises while it is imported
            raise BeamboxError(
                f'the entry point "{entry.name}" of the group {GROUP} ({entry.value}), which reads {suffix} files, '
                f"cannot be loaded: {error}"
            ) from error
        columns = decode(path, f"{suffix} file", lambda: function(path))
        lengths = {len(array) for array in columns.arrays} if isinstance(columns, Columns) else set()
        if not isinstance(columns, Columns) or len(columns.names) != len(columns.arrays) or len(lengths) > 1:
            raise BeamboxError(
                f'the entry point "{entry.name}" of the group {GROUP} ({entry.value}) must return a '
                f"beambox.data.formats.columns.Columns with as many arrays as names, all of one length; "
                f"got {columns!r:.200}"
            )
        return columns

    return read


def _entries() -> dict[str, EntryPoint]:
    return {f".{one.name.lower().removeprefix('.')}": one for one in entry_points(group=GROUP)}
