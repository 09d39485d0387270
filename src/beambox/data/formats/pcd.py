"""Point Cloud Library files (.pcd): ascii, binary and binary_compressed, through pypcd4.

The header is read here, as tools really write it (old versions, lines missing or in another order, tabs, Windows line
ends), compared with the file's size, and handed on in the one form that pypcd4 knows.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode, library
from beambox.io import read_bytes

__all__ = ["read_pcd"]

LONGEST_HEADER = 64 << 10
KEYS = {"COLUMNS": "FIELDS"}  # version .5 of the format called them so
NUMBERS = {("F", 4), ("F", 8), *((kind, size) for kind in "IU" for size in (1, 2, 4, 8))}
LARGEST_RATIO = 100
"""LZF, the compression of these files, expands at most 88 times."""


@dataclass(frozen=True)
class _Header:
    names: tuple[str, ...]
    sizes: tuple[int, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    encoding: str
    notes: tuple[str, ...] = ()

    @property
    def record(self) -> int:
        """Bytes of a point."""
        return sum(size * count for size, count in zip(self.sizes, self.counts))


def read_pcd(path: Path) -> Columns:
    """Read a PCD file; organised clouds are flattened, padding fields (``_``) left out.

    Raises:
        BeamboxError: if pypcd4 is absent, or the file is damaged, cut short, or promises more than it holds.
    """
    pypcd4 = library("pypcd4", path)
    return decode(path, "PCD file", lambda: _read(path, pypcd4))


def _read(path: Path, pypcd4: ModuleType) -> Columns:
    lines, body = _split(read_bytes(path), path)
    header = _parse(lines, body, path)
    if header.encoding == "ascii":
        arrays = _ascii(header, body, path)
    else:
        _check_size(header, body, path)
        cloud = pypcd4.PointCloud.from_fileobj(io.BytesIO(_canonical(header) + body))
        data = np.atleast_1d(cloud.pc_data)
        places = [f"f{k}" if count == 1 else f"f{k}__0000" for k, count in enumerate(header.counts)]
        arrays = [data[place] for place in places]
    kept = [k for k, name in enumerate(header.names) if name.isprintable() and name[0] not in "#_"]
    notes = list(header.notes)
    several = [header.names[k] for k in kept if header.counts[k] > 1]
    if several:
        notes.append(f"of {', '.join(several)}, which hold several numbers a point, only the first was taken")
    return Columns(tuple(header.names[k] for k in kept), [arrays[k] for k in kept], tuple(notes))


def _split(content: bytes, path: Path) -> tuple[dict[str, list[str]], bytes]:
    """Part the header's lines, by key, from the data behind them."""
    lines: dict[str, list[str]] = {}
    start = 0
    while start < min(len(content), LONGEST_HEADER):
        end = content.find(b"\n", start)
        end = len(content) if end < 0 else end
        words = content[start:end].decode("utf-8-sig" if start == 0 else "utf-8", "replace").split()
        start = end + 1
        if not words or words[0].startswith("#"):
            continue
        key = KEYS.get(words[0].upper(), words[0].upper())
        lines[key] = words[1:]
        if key == "DATA":
            return lines, content[start:]
    raise BeamboxError(f"{path} is not a readable PCD file, or is damaged (its header has no line DATA)")


def _parse(lines: dict[str, list[str]], body: bytes, path: Path) -> _Header:
    damaged = f"{path} is not a readable PCD file, or is damaged"
    names = tuple(lines.get("FIELDS", ()))
    encoding = lines["DATA"][0].lower() if lines["DATA"] else ""
    encoding = "binary_compressed" if encoding == "binaryscompressed" else encoding
    if not names or len(names) > 256:
        raise BeamboxError(f"{damaged} (its header must name 1 to 256 fields, got {len(names)})")
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise BeamboxError(f'{damaged} (expected DATA ascii, binary or binary_compressed, got "{encoding[:40]}")')

    def numbers(key: str, default: int) -> tuple[int, ...]:
        words = lines.get(key, [str(default)] * len(names))
        if len(words) != len(names) or not all(word.isascii() and word.isdigit() and len(word) < 19 for word in words):
            shown = " ".join(words)[:60]
            raise BeamboxError(f"{damaged} (line {key}: expected {len(names)} whole numbers, got {shown!r})")
        return tuple(map(int, words))

    sizes, counts = numbers("SIZE", 4), tuple(max(1, count) for count in numbers("COUNT", 1))
    types = tuple(word.upper() for word in lines.get("TYPE", ["F"] * len(names)))
    if len(types) != len(names):
        raise BeamboxError(f"{damaged} (line TYPE: expected {len(names)} letters, got {len(types)})")
    wrong = next((k for k, pair in enumerate(zip(types, sizes)) if pair not in NUMBERS), None)
    if wrong is not None:
        raise BeamboxError(
            f"{damaged} (field {names[wrong][:40]!a} has TYPE {types[wrong][:40]!a} of {sizes[wrong]} bytes)"
        )
    if sum(counts) > 4096:
        raise BeamboxError(f"{damaged} (COUNT promises {sum(counts)} numbers a point, expected at most 4096)")
    draft = _Header(names, sizes, types, counts, 0, encoding)
    points, notes = _points(lines, draft, body, damaged)
    return _Header(names, sizes, types, counts, points, encoding, notes)


def _points(lines: dict[str, list[str]], header: _Header, body: bytes, damaged: str) -> tuple[int, tuple[str, ...]]:
    """Find the number of points; WIDTH, HEIGHT and POINTS may be absent, and tools let them disagree."""
    found = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        word = (lines.get(key) or [""])[0]
        if word and not (word.isascii() and word.isdigit() and len(word) < 19):
            raise BeamboxError(f"{damaged} (line {key}: expected a whole number, got {word[:40]!a})")
        if word:
            found[key] = int(word)
    product = found["WIDTH"] * max(1, found.get("HEIGHT", 1)) if "WIDTH" in found else None
    promised = found.get("POINTS", product)
    if promised is None:
        raise BeamboxError(f"{damaged} (its header has neither POINTS nor WIDTH)")
    if product is None or product == promised:
        return promised, ()
    there = -1
    if header.encoding == "binary":
        there = len(body) // header.record
    elif header.encoding == "binary_compressed" and len(body) >= 8:
        there = struct.unpack("<I", body[4:8])[0] // header.record
    elif header.encoding == "ascii":
        there = sum(1 for line in body.splitlines() if line.strip())
    if there not in (promised, product):
        raise BeamboxError(
            f"{damaged} (POINTS says {promised}, WIDTH x HEIGHT {product}, and the data hold {there} points)"
        )
    return there, (f"the header's POINTS {promised} and WIDTH x HEIGHT {product} disagree: read {there} points",)


def _check_size(header: _Header, body: bytes, path: Path) -> None:
    """Compare what the header promises with the data that are there, before anything is made room for."""
    wanted = header.points * header.record
    if header.encoding == "binary":
        if wanted > len(body):
            raise BeamboxError(
                f"{path} is cut short: its header promises {header.points} points, "
                f"it holds {len(body) // header.record}"
            )
        return
    if header.points == 0:
        return
    if len(body) < 8:
        raise BeamboxError(f"{path} is cut short: its header promises {header.points} points, it holds 0")
    packed, unpacked = struct.unpack("<II", body[:8])
    if packed > len(body) - 8:
        raise BeamboxError(f"{path} is cut short: {packed} bytes promised, {len(body) - 8} there")
    if unpacked != wanted or unpacked > LARGEST_RATIO * max(1, packed):
        raise BeamboxError(
            f"{path} is not a readable PCD file, or is damaged ({packed} bytes cannot become {header.points} points of "
            f"{header.record} bytes)"
        )


def _canonical(header: _Header) -> bytes:
    lines = [
        "VERSION 0.7",
        f"FIELDS {' '.join(f'f{k}' for k in range(len(header.names)))}",
        f"SIZE {' '.join(map(str, header.sizes))}",
        f"TYPE {' '.join(header.types)}",
        f"COUNT {' '.join(map(str, header.counts))}",
        f"WIDTH {header.points}",
        "HEIGHT 1",
        f"POINTS {header.points}",
        f"DATA {header.encoding}",
    ]
    return "".join(line + "\n" for line in lines).encode("ascii")


def _ascii(header: _Header, body: bytes, path: Path) -> list[np.ndarray]:
    """Read the numbers of a text file, whatever parts them, each column in the type that the header gives it."""
    rows = [
        line.replace(b",", b" ") for line in body.splitlines() if line.strip() and not line.lstrip().startswith(b"#")
    ]
    if len(rows) < header.points:
        raise BeamboxError(f"{path} is cut short: its header promises {header.points} points, it holds {len(rows)}")
    width = sum(header.counts)
    table: Any = np.zeros((0, width))
    if header.points:
        table = np.loadtxt(io.BytesIO(b"\n".join(rows[: header.points])), dtype=np.float64, ndmin=2, comments=None)
    if table.shape[1] != width:
        raise BeamboxError(f"{path}: expected {width} numbers a line, as FIELDS and COUNT say, got {table.shape[1]}")
    starts = np.concatenate(([0], np.cumsum(header.counts)[:-1]))
    arrays = []
    for start, kind, size in zip(starts, header.types, header.sizes):
        column = table[:, start]
        exact = np.dtype(f"{kind.lower()}{size}")
        whole = kind != "F" and bool(np.isfinite(column).all()) and bool((column == np.round(column)).all())
        if whole and len(column):
            limits = np.iinfo(exact)
            whole = limits.min <= column.min() and column.max() <= limits.max
        arrays.append(column.astype(exact) if whole or kind == "F" else column)
    return arrays
