"""Result files for KITTI's test server: checked, then packed into the archive that it expects."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.data.kitti_text import RESULT_COLUMNS
from beambox.io import read_text, replacing

__all__ = ["KITTI_TEST_FRAMES", "KITTI_TYPES", "check_results", "write_submission"]

KITTI_TEST_FRAMES = tuple(f"{number:06d}" for number in range(7518))
"""Names of the test split's frames."""
KITTI_TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
"""Types of KITTI's label files; the server scores Car, Pedestrian and Cyclist."""
NO_ALPHA = -10.0
SHOWN = 10


def check_results(
    folder: Path | str, frames: Sequence[str] = KITTI_TEST_FRAMES, *, need_alpha: bool = True
) -> Iterator[str]:
    """Find what is wrong with a folder of result files.

    Args:
        folder: holds FRAME.txt for every frame; an empty file means that nothing was found.
        frames: names that must be there, and no others.
        need_alpha: object to an alpha of -10, with which the server leaves out the orientation score for all.

    Yields:
        One sentence a fault, naming file and line: a frame missing or unknown, a wrong number of columns, a missing
        score, a number that is none, NaN or infinite, an unknown class, a box without extent, alpha -10, nothing found
        at all.

    Raises:
        MissingFileError: if the folder is not there.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingFileError(
            f"{folder} is not a folder; expected one that holds result files such as {frames[0]}.txt"
        )
    found = {path.stem: path for path in sorted(folder.glob("*.txt"))}
    if len(found) == 0:
        yield f"{folder} holds no result file (*.txt)"
        return
    missing = [name for name in frames if name not in found]
    if missing:
        yield (
            f"{len(missing)} of {len(frames)} frames have no file, the first is {missing[0]}.txt; "
            "write an empty one where nothing was found"
        )
    known = set(frames)
    for name in found:
        if name not in known:
            yield f"{name}.txt names no frame of the split (expected {frames[0]} to {frames[-1]})"
    objects = 0
    for name, path in found.items():
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            if line.strip():
                objects += 1
                fault = _fault(line.split(), need_alpha)
                if fault:
                    yield f"{name}.txt, line {number}: {fault}"
    if objects == 0:
        yield "no file holds any detection"


def _fault(words: list[str], need_alpha: bool) -> str | None:
    """Return what is wrong with the words of one result line, or None."""
    if len(words) == RESULT_COLUMNS - 1:
        return "the score (column 16) is missing"
    if len(words) != RESULT_COLUMNS:
        return f"expected {RESULT_COLUMNS} columns, got {len(words)}"
    if words[0] not in KITTI_TYPES:
        return f'unknown class "{words[0]}"{did_you_mean(words[0], KITTI_TYPES)}'
    values = []
    for column, word in enumerate(words[1:], start=2):
        try:
            values.append(float(word))
        except ValueError:
            return f'column {column} must be a number, got "{word[:20]}"'
        if not math.isfinite(values[-1]):
            return f"column {column} must be finite, got {word}"
    alpha, (left, top, right, bottom), size = values[2], values[3:7], values[7:10]
    if right < left or bottom < top:
        return f"the image box must have left <= right and top <= bottom, got {' '.join(words[4:8])}"
    if min(size) <= 0:
        return f"height, width and length must be positive, got {' '.join(words[8:11])}"
    if need_alpha and alpha == NO_ALPHA:
        return (
            "alpha is -10 (unknown), so the server would score no orientation; give it, or allow it (need_alpha=False)"
        )
    return None


def write_submission(
    results: Path | str,
    out: Path | str,
    frames: Sequence[str] = KITTI_TEST_FRAMES,
    *,
    need_alpha: bool = True,
) -> Path:
    """Pack result files into the archive that KITTI's server expects: ``data/000000.txt`` and so on.

    Args:
        results: folder of result files, one per frame.
        out: the .zip file to write; the same files always give the same bytes.
        frames: names of the split's frames.
        need_alpha: see :func:`check_results`.

    Returns:
        ``out``.

    Raises:
        BeamboxError: listing the first faults that :func:`check_results` finds; nothing is written then.
    """
    results, out = Path(results), Path(out)
    faults = list(check_results(results, frames, need_alpha=need_alpha))
    if faults:
        more = f"\n  and {len(faults) - SHOWN} more" if len(faults) > SHOWN else ""
        details = "\n  ".join(faults[:SHOWN])
        raise BeamboxError(f"{results} cannot be submitted, {len(faults)} faults:\n  {details}{more}")
    with replacing(out) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in frames:
            entry = zipfile.ZipInfo(f"data/{name}.txt")  # dated 1980: the bytes depend on the content alone
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, (results / f"{name}.txt").read_bytes())
    return out
