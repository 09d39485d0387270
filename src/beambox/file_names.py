"""Names that become part of paths or words of text files: checked, escaped, and read from lists."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path

from beambox.checks import BeamboxError
from beambox.io import read_text

__all__ = ["check_file_name", "name_to_word", "read_names", "word_to_name"]

LONGEST_NAME = 200
"""Bytes of a name; file systems take 255, and endings are added."""
PLAIN_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,190}")  # what nearly all names are, matched quickly


def check_file_name(name: object, where: str) -> str:
    """Return a name that becomes part of a path, or refuse it where it could lead out of its folder.

    Args:
        name: of a frame, a sequence or a topic.
        where: what holds it, for the message.

    Raises:
        BeamboxError: if it is empty, no text, ``.`` or ``..``, too long, or holds a separator or a control character.
    """
    if isinstance(name, str) and PLAIN_NAME.fullmatch(name):
        return name
    if not isinstance(name, str):
        raise BeamboxError(f"{where}: a name must be text, got {type(name).__name__}")
    fault = None
    if name.strip() == "" or set(name) == {"."}:
        fault = "is not one"
    elif any(mark in name for mark in "/\\") or (os.name == "nt" and any(mark in name for mark in ':*?"<>|')):
        fault = "holds a separator of folders"
    elif any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in name):
        fault = "holds control characters"
    elif len(name.encode("utf-8")) > LONGEST_NAME:
        fault = f"has more than {LONGEST_NAME} bytes"
    if fault:
        shown = name if len(name) <= 60 else name[:60] + "..."
        raise BeamboxError(f'{where}: a name must be a plain file name such as "000123", but {shown!a} {fault}')
    return name


def name_to_word(name: str, reserved: str = "DontCare") -> str:
    """Write the name of a class as one word of a text file whose columns are parted by blanks.

    Blanks, control characters and what would make the word another thing are written as ``%20`` and the like;
    :func:`word_to_name` reads them back.

    Args:
        name: any text.
        reserved: a word, in any case, that means something else in the file.
    """
    if not name or name.lower() == reserved.lower() or name.startswith("#"):
        return "%" + (f"{ord(name[0]):02x}{_escaped(name[1:])}" if name else "00")
    return _escaped(name)


def _escaped(name: str) -> str:
    plain = lambda letter: letter.isprintable() and not letter.isspace() and letter != "%"
    return "".join(
        letter if plain(letter) else "".join(f"%{byte:02x}" for byte in letter.encode("utf-8", "replace"))
        for letter in name
    )


def word_to_name(word: str) -> str:
    """Return the name that :func:`name_to_word` wrote; a ``%`` that begins no such code stands for itself."""
    if "%" not in word:
        return word
    if word == "%00":
        return ""
    coded = re.sub(
        r"((?:%[0-9a-f]{2})+)", lambda m: bytes.fromhex(m[1].replace("%", "")).decode("utf-8", "replace"), word
    )
    return coded if name_to_word(coded) == word else word


def read_names(path: Path, remedy: str = "") -> list[str]:
    """Read a list of names, one per line (or several, parted by blanks), each a plain file name and there once.

    Raises:
        MissingFileError: if the list is not there.
        BeamboxError: if it is empty, repeats a name or holds one that :func:`check_file_name` refuses.
    """
    names = read_text(path, remedy).split()
    if not names:
        raise BeamboxError(f"{path} must hold names, one per line, but is empty")
    seen: set[str] = set()
    for name in names:
        check_file_name(name, str(path))
        if name in seen:
            raise BeamboxError(f"{path} must name each frame once, but names {name} again")
        seen.add(name)
    return names
