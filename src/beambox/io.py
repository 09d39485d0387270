"""Reading and writing whole files: the ground floor that every reader and writer stands on.

What is written appears under its name only once it is complete; a killed process leaves at most a hidden
``.NAME.HOST-PID-TOKEN.part``, which the next write into the folder removes. What is read is checked for its encoding
here, once: UTF-8, with or without a byte order mark.
"""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from beambox.checks import BeamboxError, MissingFileError

__all__ = [
    "parse_json",
    "parse_yaml",
    "read_bytes",
    "read_json",
    "read_text",
    "read_yaml",
    "replacing",
    "write_bytes",
    "write_json",
    "write_text",
]

LARGEST_TEXT = 256 << 20
"""Text files beyond this many bytes are refused before they are read."""
LARGEST_YAML = 1 << 20
"""Recipes and descriptions are written by hand; larger files are something else."""
MOST_NODES = 100_000
"""Values that a YAML file may stand for once its aliases are written out."""
ABANDONED = 86_400
"""A draft whose writer cannot be asked after is left over once it is older than this many seconds."""
DRAFT = re.compile(r"\..+\.(?P<host>[0-9a-f]{8})-(?P<pid>[0-9]+)-[0-9a-f]{8}\.part")
FORMER_DRAFT = re.compile(r"\..+\.(safetensors|onnx|json)\.(?=[a-z_]*[0-9_])[a-z0-9_]{8}|\..+\.[a-z0-9_]{8}\.part")

_swept: set[str] = set()  # folders that this process has looked through for drafts


# ---------------------------------------------------------------- reading


def read_bytes(path: Path, remedy: str = "", *, limit: int | None = None) -> bytes:
    """Read a whole file.

    Args:
        path: the file.
        remedy: what to do where it is absent, appended to the message.
        limit: refuse a larger file, bytes.

    Raises:
        MissingFileError: if it is not there.
        BeamboxError: if it is a folder, may not be read, or is too large.
    """
    try:
        size = path.stat().st_size
        if limit is not None and size > limit:
            raise BeamboxError(f"{path} has {size / 1e6:.0f} MB, expected at most {limit / 1e6:.0f} MB")
        return path.read_bytes()
    except FileNotFoundError:
        raise MissingFileError(f"{path} is not there" + (f"; {remedy}" if remedy else "")) from None
    except OSError as error:
        raise BeamboxError(f"{path} cannot be read: {error.strerror or error}") from None
    except ValueError as error:
        if isinstance(error, BeamboxError):
            raise
        raise BeamboxError(f"{str(path)!r} cannot be the name of a file: {error}") from None


def read_text(path: Path, remedy: str = "", *, limit: int = LARGEST_TEXT) -> str:
    """Read a text file: UTF-8, a byte order mark passed over.

    Raises:
        MissingFileError: if it is not there.
        BeamboxError: if it is UTF-16 or UTF-32, Latin-1 or another code page, or no text; see also :func:`read_bytes`.
    """
    return decode_text(read_bytes(path, remedy, limit=limit), str(path))


def decode_text(content: bytes, where: str) -> str:
    """Decode a text file's bytes; see :func:`read_text`.

    Args:
        content: of the file.
        where: what to call it in messages.
    """
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff", b"\x00\x00\xfe\xff")) or b"\0" in content[:4]
    if wide and _mostly_zero_padded(content):
        raise BeamboxError(
            f"{where} is text in UTF-16 or UTF-32 (as PowerShell's `>` writes), expected UTF-8: save it as UTF-8"
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise BeamboxError(
            f"{where} must be text in UTF-8, but line {line} holds the byte 0x{content[error.start]:02x}: "
            "it is binary, or text in an older encoding such as Latin-1 or Windows-1252; save it as UTF-8"
        ) from None
    if "\0" in text:
        raise BeamboxError(f"{where} must be a text file, but holds zero bytes: it is binary or damaged")
    return text


def _mostly_zero_padded(content: bytes) -> bool:
    """Tell UTF-16 and UTF-32 from other bytes: every second byte of Latin text is 0 there, or a mark leads."""
    return content.startswith((b"\xff\xfe", b"\xfe\xff")) or content[:2000].count(0) * 3 >= len(content[:2000])


def parse_json(text: str, where: str) -> Any:
    """Parse JSON; numbers are finite floats or integers of at most 18 digits, longer ones become floats.

    Raises:
        BeamboxError: if it is not JSON, nested beyond sense, or holds a number beyond float or NaN.
    """

    def whole(digits: str) -> int | float:
        return int(digits) if len(digits) <= 18 else fraction(digits)

    def fraction(digits: str) -> float:
        value = float(digits)
        if value in (float("inf"), float("-inf")):
            raise BeamboxError(f"{where}: the number {digits[:20]}... is beyond what a float can hold")
        return value

    def refused(word: str) -> NoReturn:
        raise BeamboxError(f"{where}: expected finite numbers, got {word}")

    try:
        return json.loads(text, parse_int=whole, parse_float=fraction, parse_constant=refused)
    except BeamboxError:
        raise
    except RecursionError:
        raise BeamboxError(f"{where} is nested too deeply to be what it should be") from None
    except ValueError as error:
        raise BeamboxError(f"{where} is not valid JSON: {error}") from None


def read_json(path: Path, remedy: str = "") -> Any:
    """Read a JSON file; see :func:`read_text` and :func:`parse_json`."""
    return parse_json(read_text(path, remedy), str(path))


def parse_yaml(text: str, where: str) -> Any:
    """Parse YAML into plain values.

    Raises:
        BeamboxError: if it is not YAML, repeats a key, is nested too deeply, or grows out of proportion by its aliases.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict:
            keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.value != "<<"]
            twice = next((key for key in keys if keys.count(key) > 1), None) if len(keys) < 1000 else None
            if twice is not None:
                raise BeamboxError(f"{where}{node.start_mark}: the key {twice!r} stands here twice".replace("\n", " "))
            return super().construct_mapping(node, deep)

    try:
        values = yaml.load(text, Loader)  # derived from SafeLoader
        _count_nodes(values, where)
    except BeamboxError:
        raise
    except RecursionError:
        raise BeamboxError(f"{where} is nested too deeply to be what it should be") from None
    except yaml.YAMLError as error:
        raise BeamboxError(f"{where} is not valid YAML: {' '.join(str(error).split())[:300]}") from None
    except Exception as error:  # PyYAML's constructors raise whatever int, date and base64 raise
        details = " ".join(str(error).split())[:120]
        raise BeamboxError(f"{where} is not valid YAML: {type(error).__name__}: {details}") from None
    return values


def read_yaml(path: Path, remedy: str = "") -> Any:
    """Read a YAML file; see :func:`read_text` and :func:`parse_yaml`."""
    return parse_yaml(read_text(path, remedy, limit=LARGEST_YAML), str(path))


def _count_nodes(values: Any, where: str) -> None:
    """Refuse aliases that multiply: each container is counted once, by what it stands for."""
    counted: dict[int, int] = {}

    def count(value: Any) -> int:
        if not isinstance(value, dict | list | tuple | set):
            return 1
        known = counted.get(id(value))
        if known is not None:
            return known
        counted[id(value)] = MOST_NODES + 1  # a container inside itself never ends
        inside = [*value.keys(), *value.values()] if isinstance(value, dict) else value
        counted[id(value)] = 1 + sum(count(one) for one in inside)
        return counted[id(value)]

    if count(values) > MOST_NODES:
        raise BeamboxError(f"{where} stands for more than {MOST_NODES} values: its aliases multiply")


# ---------------------------------------------------------------- writing


@contextmanager
def replacing(path: Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of ``path`` only once it is complete.

    Args:
        path: the file; its folder is made where it is absent. Devices (``/dev/stdout``) are written to as they are.
        sync: have the content on the disk before it takes the place: for what took hours to compute.

    Raises:
        BeamboxError: if it cannot be written, as on a full disk; what stood there before is then still whole.
    """
    path = Path(path)
    if path.is_dir():
        raise BeamboxError(f"cannot write {path}: it is a folder, expected the name of a file")
    try:
        if path.as_posix().startswith(("/dev/", "/proc/")) or (path.exists() and not path.is_file()):
            with path.open("wb") as stream:
                yield stream
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(path.parent, again=sync)
        draft = path.with_name(f".{path.name[:40]}.{_host()}-{os.getpid()}-{secrets.token_hex(4)}.part")
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        handle = os.open(draft, flags, 0o666)  # unlike mkstemp's, readable by all whom the umask lets
        try:
            with os.fdopen(handle, "wb") as stream:
                yield stream
                if sync:
                    stream.flush()
                    os.fsync(stream.fileno())
            os.replace(draft, path)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        if isinstance(error, BeamboxError):
            raise
        room = "; free some space or give another folder" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        details = f"cannot write {path}: {error.strerror or error}{room}; nothing half-written is left"
        raise BeamboxError(details) from error


def write_bytes(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a whole file; see :func:`replacing`."""
    with replacing(path, sync=sync) as stream:
        stream.write(content)


def write_text(path: Path, content: str, *, sync: bool = False) -> None:
    """Write a whole text file, UTF-8 with newlines as given; see :func:`replacing`.

    Letters that UTF-8 cannot hold (parts of file names that are not text) are written as escapes.
    """
    write_bytes(path, content.encode("utf-8", "backslashreplace"), sync=sync)


def write_json(path: Path, content: Any, *, indent: int | None = 1, sync: bool = False) -> None:
    """Write a JSON file that any reader takes: no NaN, a newline at the end; see :func:`replacing`.

    Raises:
        BeamboxError: if the content holds NaN or an infinity, or cannot be written.
    """
    try:
        text = json.dumps(content, indent=indent, allow_nan=False)
    except ValueError as error:
        raise BeamboxError(f"cannot write {path}: {error}; JSON holds finite numbers alone") from None
    write_text(path, text + "\n", sync=sync)


def _host() -> str:
    import platform

    return f"{zlib.crc32(platform.node().encode('utf-8', 'replace')):08x}"


def _remove_abandoned(folder: Path, *, again: bool) -> None:
    """Remove drafts of writers that were killed; folders of very many files are looked through once per process."""
    key = os.path.abspath(folder)
    if key in _swept and not again:
        return
    _swept.add(key)
    with os.scandir(folder) as entries:
        hidden = [entry for entry in entries if entry.name.startswith(".")]
    for entry in hidden:
        draft = DRAFT.fullmatch(entry.name)
        if draft is None and FORMER_DRAFT.fullmatch(entry.name) is None:
            continue
        try:
            if entry.is_file(follow_symlinks=False) and not _in_work(entry, draft and draft.groupdict()):
                os.unlink(entry.path)
        except OSError:
            continue  # another process was quicker, or it is not ours to remove


def _in_work(entry: os.DirEntry, draft: Mapping[str, str] | None) -> bool:
    if draft is None:
        return False  # names of former versions: nothing here writes them any more
    if os.name != "nt" and draft["host"] == _host():
        try:
            os.kill(int(draft["pid"]), 0)  # on Windows this would end the process
        except (ProcessLookupError, OverflowError):
            return False
        except PermissionError:
            return True
        return True
    return time.time() - entry.stat().st_mtime < ABANDONED
