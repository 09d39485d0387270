"""Records of boxes as text and as tables: JSON, CSV, pandas; and back from text."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from beambox import io
from beambox.checks import BeamboxError, import_library, printable

if TYPE_CHECKING:
    import numpy as np
    import pandas  # pyright: ignore[reportMissingTypeStubs]

__all__ = [
    "BOX",
    "Record",
    "counted",
    "csv_text",
    "frame_of_array",
    "frame_of_rows",
    "json_text",
    "parse_csv",
    "parse_json",
    "rounded",
]

BOX = ("x", "y", "z", "l", "w", "h", "yaw")
"""Columns of a box: metres and radians."""

Row = Mapping[str, float | str]
Record: TypeAlias = dict[str, Any]
"""A row that was read: text under ``name``, finite numbers under the other columns."""


def rounded(rows: Iterable[Row]) -> list[dict[str, float | str]]:
    """Round to a tenth of a millimetre and of a milliradian: what is beyond is noise."""
    return [{key: round(v, 4) if isinstance(v, float) else v for key, v in row.items()} for row in rows]


def json_text(rows: Sequence[Row], head: Mapping[str, object], under: str) -> str:
    """Write one JSON object: what ``head`` holds, and the rows as a list, one per line."""
    objects = ",\n".join("    " + json.dumps(row) for row in rows)
    start = json.dumps(head, indent=2)[:-2] + ",\n" if head else "{\n"
    return start + f'  "{under}": [' + (f"\n{objects}\n  " if rows else "") + "]\n}\n"


def csv_text(rows: Iterable[Row], columns: Sequence[str]) -> str:
    """Write rows below a header line."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([row[key] for key in columns] for row in rows)
    return text.getvalue()


def parse_csv(text: str, where: str, columns: Sequence[str]) -> list[Record]:
    """Read rows below a header line; numbers are finite.

    Raises:
        BeamboxError: naming the line.
    """
    try:
        reader = csv.DictReader(StringIO(text))
        lacking = [key for key in columns if key not in (reader.fieldnames or ())]
        if lacking:
            raise BeamboxError(f"{where} needs a header line with the columns {','.join(columns)}; {lacking[0]} lacks")
        return [_row(row, columns, f"{where}, line {number}") for number, row in enumerate(reader, start=2)]
    except csv.Error as error:
        raise BeamboxError(f"{where} is no CSV: {error}") from None


def parse_json(text: str, where: str, under: str, columns: Sequence[str]) -> tuple[dict[str, object], list[Record]]:
    """Read what :func:`json_text` wrote: the whole object, and its rows with finite numbers.

    Raises:
        BeamboxError: naming the entry.
    """
    content: object = io.parse_json(text, where)
    rows = cast("dict[str, object]", content).get(under) if isinstance(content, dict) else None
    if not isinstance(content, dict) or not isinstance(rows, list):
        raise BeamboxError(f'{where} must hold an object with a list under "{under}", as beambox writes it')
    numbered = enumerate(cast("list[object]", rows), start=1)
    whole = cast("dict[str, object]", content)
    return whole, [_row(row, columns, f"{where}, entry {number}") for number, row in numbered]


def _row(row: object, columns: Sequence[str], place: str) -> Record:
    known = cast("dict[str, Any]", row) if isinstance(row, dict) else {}
    if any(known.get(key) is None for key in columns):
        raise BeamboxError(f"{place}: expected {', '.join(columns)}, got {row!r:.120}")
    out: Record = {}
    for key in columns:
        if key == "name":
            if not isinstance(known[key], str):
                raise BeamboxError(f"{place}: the name must be text, got {known[key]!r:.80}")
            out[key] = known[key]
            continue
        try:
            out[key] = float(known[key]) if not isinstance(known[key], bool) else math.nan
        except (TypeError, ValueError, OverflowError):
            out[key] = math.nan
        if not math.isfinite(out[key]) or abs(out[key]) > 1e30:  # beyond float32
            raise BeamboxError(f"{place}: {key} must be a finite number, got {known[key]!r:.80}")
    return out


def frame_of_rows(rows: Sequence[Row], columns: Sequence[str]) -> pandas.DataFrame:
    """Make a table of pandas; its columns are there without rows too.

    Raises:
        BeamboxError: if pandas is not installed.
    """
    return _pandas().DataFrame(list(rows), columns=list(columns))


def frame_of_array(array: np.ndarray, columns: Sequence[str]) -> pandas.DataFrame:
    """Make a table of pandas from an array with as many columns as names."""
    return _pandas().DataFrame(array, columns=list(columns))


def _pandas() -> Any:
    return import_library("pandas", "tables", "a table")


def counted(names: Sequence[str]) -> str:
    """Count names, most frequent first, such as "3 Car, 1 Van"; "nothing" where there is none."""
    shown = [f"{number} {printable(name[:40])}" for name, number in Counter(names).most_common(6)]
    more = len(set(names)) - len(shown)
    return (", ".join(shown) + (f" and {more} other classes" if more > 0 else "")) or "nothing"
