"""Polygon files (.ply), ascii and binary, through plyfile: the points are the vertices.

The header is read here first: what it promises is compared with the file's size, and what tools write differently
(Windows line ends, comments in any encoding, another name of the vertices) is brought into plyfile's form.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from beambox.checks import BeamboxError
from beambox.data.formats.columns import Columns, decode, library
from beambox.io import read_bytes

__all__ = ["read_ply"]

LONGEST_HEADER = 64 << 10
SIZES = {
    **{name: 1 for name in ("char", "uchar", "int8", "uint8")},
    **{name: 2 for name in ("short", "ushort", "int16", "uint16")},
    **{name: 4 for name in ("int", "uint", "int32", "uint32", "float", "float32")},
    **{name: 8 for name in ("double", "float64")},
}
VERTICES = ("vertex", "vertices", "point", "points")


@dataclass
class _Element:
    name: str
    count: int
    lines: list[str] = field(default_factory=list)
    smallest: int = 0
    """Bytes that an entry takes at least."""


def read_ply(path: Path) -> Columns:
    """Read the vertices of a PLY file; list properties are left out.

    Raises:
        BeamboxError: if plyfile is absent, or the file is damaged, cut short, promises more than it holds, or has no
            vertices.
    """
    plyfile = library("plyfile", path)
    return decode(path, "PLY file", lambda: _read(path, plyfile))


def _read(path: Path, plyfile: ModuleType) -> Columns:
    head, elements, body = _parse(read_bytes(path), path)
    if not any(element.name == "vertex" for element in elements):
        found = ", ".join(element.name for element in elements) or "nothing"
        raise BeamboxError(f"{path} must have the element `vertex`, got {found}")
    needed = sum(element.count * element.smallest for element in elements)
    if needed > len(body):
        raise BeamboxError(
            f"{path} is cut short, or is damaged: its header promises at least {needed} bytes of data, it holds "
            f"{len(body)}"
        )
    parsed = plyfile.PlyData.read(io.BytesIO(head + body), mmap=False)
    data = next(element for element in parsed.elements if element.name == "vertex").data
    names = tuple(name for name in data.dtype.names or () if data.dtype[name].kind in "fiu")
    return Columns(names, [data[name] for name in names])


def _parse(content: bytes, path: Path) -> tuple[bytes, list[_Element], bytes]:
    """Return the header in plyfile's form, its elements, and the data behind it."""

    def damaged(reason: str) -> BeamboxError:
        return BeamboxError(f"{path} is not a readable PLY file, or is damaged ({reason})")

    end = content.find(b"end_header", 0, LONGEST_HEADER)
    if end < 0 or not content.removeprefix(b"\xef\xbb\xbf").startswith(b"ply"):
        raise damaged("it has no header of the form ply ... end_header")
    start = end + len(b"end_header")
    for line_end in (b"\r\n", b"\n", b"\r"):
        if content.startswith(line_end, start):
            start += len(line_end)
            break
    form, elements = "", []
    for line in content[:end].decode("utf-8-sig", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) >= 2:
            form = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isascii() and words[2].isdigit():
            if len(words[2]) > 18:
                raise damaged(f"it promises {words[2][:30]} entries")
            name = "vertex" if words[1].lower() in VERTICES else words[1]
            elements.append(_Element(name, int(words[2])))
        elif words[0] == "property" and elements and len(words) >= 3:
            _add_property(elements[-1], words, form == "ascii", damaged)
        else:
            raise damaged(f"its header holds the line {line[:60]!a}")
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise damaged(f"format must be ascii, binary_little_endian or binary_big_endian, got {form[:40]!a}")
    for element in elements:
        if element.count and not element.lines:
            raise damaged(f"it promises {element.count} entries {element.name!a} without any property")
    lines = ["ply", f"format {form} 1.0"]
    for element in elements:
        lines += [f"element {element.name} {element.count}", *element.lines]
    return "".join(line + "\n" for line in [*lines, "end_header"]).encode("ascii", "replace"), elements, content[start:]


def _add_property(element: _Element, words: list[str], text: bool, damaged: Callable[[str], BeamboxError]) -> None:
    kinds = words[2:4] if words[1] == "list" else words[1:2]
    unknown = next((kind for kind in kinds if kind.lower() not in SIZES), None)
    if unknown is not None or (words[1] == "list" and len(words) < 5):
        raise damaged(f"its header holds the property {' '.join(words)[:60]!a}")
    name = "_".join(words[4:] if words[1] == "list" else words[2:])  # CloudCompare's names may hold blanks
    start = f"list {kinds[0].lower()} {kinds[1].lower()}" if words[1] == "list" else kinds[0].lower()
    element.lines.append(f"property {start} {name}")
    # a number of text takes a digit and what parts it from the next; a list at least its length
    element.smallest += 1 if text else SIZES[kinds[0].lower()]
