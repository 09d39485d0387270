"""What a table of a paper is: columns, rows, switches and published numbers; `beambox ablate` trains the rows again.

Switches are options of the detector on top of the recipe's; a row without them is quoted from the paper, not trained.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["CAR_3D_R11", "TIME", "Column", "Row", "Table", "levels"]

LEVELS = ("easy", "moderate", "hard")


@dataclass(frozen=True)
class Column:
    """One number of every row."""

    group: str
    """Metric with its protocol, such as ``Car 3-D R11``."""
    name: str
    """Its part, such as ``moderate``."""
    path: tuple[str | int, ...]
    """Where the number stands in what scoring gives (``to_json()``), such as ``("Car", "3d", "R11", 1)``."""


def levels(name: str, metric: str, recalls: str) -> tuple[Column, ...]:
    """Return KITTI's three columns of a class: easy, moderate, hard.

    Args:
        name: of the class.
        metric: ``3d``, ``bev``, ``2d`` or ``aos``.
        recalls: ``R11`` or ``R40``.
    """
    title = {"3d": "3-D", "bev": "BEV", "2d": "2-D", "aos": "AOS"}[metric]
    return tuple(
        Column(f"{name} {title} {recalls}", level, (name, metric, recalls, i)) for i, level in enumerate(LEVELS)
    )


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    name: str
    """As the paper calls it."""
    published: tuple[float | None, ...]
    """The paper's number of each column; None where it has none."""
    options: Mapping[str, Any] | None = None
    """Switches: what the detector's options are beyond the recipe's. None for a row that is quoted and not trained."""


@dataclass(frozen=True)
class Table:
    """A table of a paper."""

    title: str
    """Paper, number and what is compared."""
    protocol: str
    """What the paper's numbers were measured on."""
    recipe: str
    """Name of the shipped recipe of every row."""
    columns: tuple[Column, ...]
    """What is measured."""
    rows: tuple[Row, ...]
    """In the paper's order."""
    remarks: tuple[str, ...] = ()
    """What a reader of the paper's numbers should know."""

    def __post_init__(self) -> None:
        for row in self.rows:
            assert len(row.published) == len(self.columns), f"{self.title}, {row.name}: a number for each column"


CAR_3D_R11 = levels("Car", "3d", "R11")
TIME = Column("time", "ms", ("time", "ms"))
"""Of one sweep; ours is the median, one sweep at a time, from points to boxes, without reading files."""
