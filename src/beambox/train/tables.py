"""The tables that `beambox ablate` trains again, by name; each paper's stand in a file of their own.

Switches are options of the detector on top of the recipe's; a row without them is quoted from the paper, not trained.
"""

from __future__ import annotations

from beambox.checks import BeamboxError, did_you_mean
from beambox.train.table import Column, Row, Table, levels
from beambox.train.tables_dennet import DENNET
from beambox.train.tables_hcnet import HCNET
from beambox.train.tables_kassd import KASSD

__all__ = ["TABLES", "Column", "Row", "Table", "levels", "table_of"]

TABLES: dict[str, Table] = {**DENNET, **HCNET, **KASSD}


def table_of(name: str) -> Table:
    """Look a table up.

    Raises:
        BeamboxError: naming the nearest one.
    """
    if name not in TABLES:
        raise BeamboxError(f'there is no table "{name}"{did_you_mean(name, TABLES)}')
    return TABLES[name]
