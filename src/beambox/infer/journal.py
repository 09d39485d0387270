"""Detections of very many sweeps in few files: appended sweep by sweep, each exactly once, also after a kill.

A journal is a file of JSON lines. Every box is a row with its sweep; behind the rows of a sweep stands one that says
the sweep is done, and how many boxes it has. All rows of a sweep are appended in one piece; what a killed process left
without its last row is cut off when the journal is opened again.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from beambox.checks import BeamboxError, import_library
from beambox.io import parse_json, replacing
from beambox.structures import Detections

__all__ = ["COLUMNS", "Journal", "done_in", "need_pyarrow", "rows_in", "write_parquet"]

COLUMNS = ("sweep", "name", "score", *"xyzlwh", "yaw")
PATIENCE = 20.0
"""Seconds to wait for a journal that another process has open: the workers of a killed run finish their sweep first."""
DONE = '{"done": '
"""How the row begins that ends a sweep."""
BEGINNINGS = (DONE.encode(), b'{"sweep": ')


class Journal:
    """A file of rows that one process appends to."""

    def __init__(self, path: Path) -> None:
        """Open a journal, or begin it.

        Raises:
            BeamboxError: if another process writes it, or the file holds something else.
        """
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        try:
            _lock(self._handle, path)
            whole, self.done = _whole_part(path)
            os.ftruncate(self._handle, whole)
            os.lseek(self._handle, whole, os.SEEK_SET)
        except BaseException:
            os.close(self._handle)
            raise

    def append(self, sweep: str, found: Detections) -> None:
        """Write the boxes of a sweep; they count once the last byte is there.

        Raises:
            OSError: as on a full disk; the journal is then as it was before.
        """
        rows = [json.dumps({"sweep": sweep, **_rounded(row)}) for row in found.to_rows()]
        rows.append(f'{DONE}{json.dumps(sweep)}, "boxes": {len(found)}}}')
        content = memoryview(("\n".join(rows) + "\n").encode())
        begin = os.lseek(self._handle, 0, os.SEEK_CUR)
        try:
            while content:
                content = content[os.write(self._handle, content) :]
        except OSError:
            os.ftruncate(self._handle, begin)
            os.lseek(self._handle, begin, os.SEEK_SET)
            raise

    def close(self) -> None:
        """Close the file, so that others may write it."""
        os.close(self._handle)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def done_in(folder: Path) -> set[str]:
    """Return the sweeps that any journal of a folder holds."""
    done: set[str] = set()
    for path in sorted(folder.glob("*.jsonl")) if folder.is_dir() else ():
        with path.open("rb") as stream:
            for line in stream:
                if line.startswith(DONE.encode()) and line.endswith(b"}\n"):
                    done.add(parse_json(line.decode(), str(path))["done"])
    return done


def rows_in(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of boxes of a journal, those of whole sweeps alone."""
    pending: list[dict[str, Any]] = []
    with path.open("rb") as stream:
        for line in stream:
            if not line.endswith(b"\n"):
                return
            if line.startswith(DONE.encode()):
                yield from pending
                pending = []
            else:
                pending.append(parse_json(line.decode(), str(path)))


def write_parquet(journals: Sequence[Path], out: Path) -> int:
    """Write the boxes of journals as one Parquet file, one row per box; returns how many.

    Raises:
        BeamboxError: if pyarrow is not installed.
    """
    arrow, parquet = _pyarrow()
    schema = arrow.schema(
        [(name, arrow.string() if name in ("sweep", "name") else arrow.float32()) for name in COLUMNS]
    )
    count = 0
    with replacing(out) as stream, parquet.ParquetWriter(stream, schema) as writer:
        for path in journals:
            pending: list[dict[str, Any]] = []
            for row in rows_in(path):
                pending.append(row)
                if len(pending) == 100_000:
                    writer.write_table(arrow.Table.from_pylist(pending, schema=schema))
                    count, pending = count + len(pending), []
            writer.write_table(arrow.Table.from_pylist(pending, schema=schema))
            count += len(pending)
    return count


def need_pyarrow() -> None:
    """Refuse Parquet before the work begins where its library is not there."""
    _pyarrow()


def _pyarrow() -> tuple[Any, Any]:
    arrow, parquet = (
        import_library(name, "parquet", "writing Parquet files", "or write --format jsonl")
        for name in ("pyarrow", "pyarrow.parquet")
    )
    return arrow, parquet


def _rounded(row: dict[str, float | str]) -> dict[str, float | str]:
    chosen = {key: row[key] for key in COLUMNS[1:]}
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in chosen.items()}


def _whole_part(path: Path) -> tuple[int, set[str]]:
    """Return how many bytes lead up to the end of the last whole sweep, and the sweeps in them."""
    whole = place = 0
    done: set[str] = set()
    with path.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            place += len(line)
            if number == 1 and not any(line[: len(one)] == one[: len(line)] for one in BEGINNINGS):
                raise BeamboxError(f"{path} is no journal of detections; give another folder")
            if line.startswith(DONE.encode()) and line.endswith(b"}\n"):
                whole = place
                done.add(parse_json(line.decode(), str(path))["done"])
    return whole, done


def _lock(handle: int, path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: nothing keeps two processes apart there
        return
    patience = time.monotonic() + PATIENCE
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > patience:
                raise BeamboxError(f"another process writes {path}; give each its own --shard i/n") from None
            time.sleep(0.1)
        except OSError:
            return  # a file system without locks
