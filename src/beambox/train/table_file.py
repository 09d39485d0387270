"""A table of one's own for `beambox ablate --table`: a YAML file of rows and the options each of them switches."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from beambox.checks import BeamboxError, MissingFileError
from beambox.io import read_yaml
from beambox.train.table import Row, Table, levels

__all__ = ["TableFile", "read_table"]


class TableFile(BaseModel):
    """A table of one's own, as its YAML file has it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    recipe: str
    rows: dict[str, dict[str, Any]] = Field(min_length=1)
    classes: list[str] = Field(min_length=1)
    metric: Literal["3d", "bev", "2d", "aos"] = "3d"
    recalls: Literal["R40", "R11"] = "R40"


def read_table(path: Path) -> Table:
    """Read a table of one's own: rows by name, each with the options of the detector that it switches.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: naming the key that is wrong.
    """
    if not path.is_file():
        raise MissingFileError(f"--table: there is no file {path}")
    try:
        given = TableFile.model_validate(read_yaml(path))
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, one['loc'])) or 'the file'}: {one['msg']}" for one in error.errors()]
        raise BeamboxError(f"{path}: {'; '.join(faults)}") from None
    columns = tuple(column for name in given.classes for column in levels(name, given.metric, given.recalls))
    none = (None,) * len(columns)
    rows = tuple(Row(name, none, options) for name, options in given.rows.items())
    return Table(given.title, "no paper: a table of one's own", given.recipe, columns, rows)
