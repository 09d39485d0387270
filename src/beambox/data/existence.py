"""Whether inputs are there, asked before anything heavy is loaded; this module imports neither torch nor NumPy."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from pathlib import Path

from beambox.checks import MissingFileError

__all__ = ["expect_data", "expect_inputs"]


def expect_inputs(inputs: Iterable[str | Path]) -> None:
    """Check that files, folders and patterns name something; what lies in a recording is left to its reader.

    Raises:
        MissingFileError: for the first that names nothing, with what lies beside it.
    """
    for given in map(str, inputs):
        path = Path(given)
        if path.exists() or any(above.is_file() or (above / "metadata.yaml").is_file() for above in path.parents):
            continue
        if not glob.has_magic(given):
            beside = sorted(p.name for p in path.parent.glob("*") if p.is_file() and not p.name.startswith("."))[:3]
            hint = f"; {path.parent}/ holds {', '.join(beside)} ..." if beside else ""
            raise MissingFileError(f"{given} is not there{hint}")
        if next(glob.iglob(given, recursive=True), None) is None:
            raise MissingFileError(f"no file fits the pattern {given}")


def expect_data(path: Path | None) -> None:
    """Check that a data set is there, where one is given.

    Raises:
        MissingFileError: naming it.
    """
    if path is not None and not path.exists():
        kind = "file" if path.suffix in (".yaml", ".yml") else "folder"
        raise MissingFileError(f"--data: there is no {kind} {path}")
