"""Raw float32 records (.bin), as KITTI, ONCE and nuScenes store sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError
from beambox.io import read_bytes

__all__ = ["read_bin"]

PRINTABLE = bytes(range(0x20, 0x7F)) + b"\t\r\n"
NAMES = ("x", "y", "z", "intensity", "ring", "time")
PERIODS = (3, 4, 5, 6, 7, 8)
"""Numbers of columns that sweeps are written with."""
FEWEST = 1000
"""Fewer numbers than this do not tell."""
FIRST = 120_000
"""So many numbers of a file tell how many columns it has."""
FARTHEST = 1e6
"""Coordinates beyond this many metres mean that the bytes are something else."""


def read_bin(path: Path, columns: int | None = None) -> np.ndarray:
    """Read little-endian float32 records.

    Args:
        path: the file.
        columns: numbers a point; the first three are taken for coordinates. None expects four, and refuses a file
            whose numbers repeat their kind with another period.

    Returns:
        ``(N, columns)`` float32, writable; may hold NaN.

    Raises:
        BeamboxError: if the size is not a whole number of points, or the content is text or another number type.
    """
    assumed, columns = columns is None, columns or 4
    content = read_bytes(path)
    head = content[:4096]
    if len(head) >= 8 and len(head.translate(None, PRINTABLE)) <= len(head) // 50:
        start = head[:30].decode("ascii", "replace")
        raise BeamboxError(
            f"{path} must hold binary float32 numbers, but is a text file (it begins {start!r}); "
            "give it the ending of its format, or write the points with numpy's tofile"
        )
    record = 4 * columns
    if len(content) % record:
        raise BeamboxError(
            f"{path} must hold whole points of {columns} float32 numbers ({record} bytes), but has {len(content)} "
            f"bytes, {len(content) % record} too many: it is cut short, or has another number of columns"
            f"{_other_columns(content, columns)}"
        )
    points = np.frombuffer(content, dtype="<f4").reshape(-1, columns).astype(np.float32)
    if _implausible(points[:, :3]):
        guess = np.frombuffer(content[: len(content) // 8 * 8], dtype="<f8")
        hint = ""
        if not _implausible(guess[:3000]):
            hint = "; it looks like float64: convert it with points.astype('float32').tofile(...)"
        raise BeamboxError(
            f"{path} must hold float32 x, y, z in metres, but most numbers are no sensible coordinates{hint}"
        )
    period = repeated_kinds(points.reshape(-1)) if assumed else columns
    if period != columns:
        names = ",".join(NAMES[:period] + tuple("_" for _ in range(period - len(NAMES))))
        negative = float((points[:, 3] < 0).mean())
        raise BeamboxError(
            f"{path} looks like points of {period} float32 numbers instead of 4 (read as 4, {negative:.0%} of the "
            f'intensities would be negative): name its columns, such as --fields {names} (`fields="{names}"`), or '
            "--fields x,y,z,intensity if they are 4 all the same"
        )
    return points


def repeated_kinds(numbers: np.ndarray, assumed: int = 4) -> int:
    """Return after how many numbers their kind repeats: how many columns a stream of records has.

    Columns differ in size, in sign and in being whole numbers. For each possible number of columns the share of the
    variance that the columns explain is compared; the one assumed is kept unless another explains far more.

    Args:
        numbers: ``(N,)`` as they stand in the file.
        assumed: number of columns to keep in doubt.
    """
    with np.errstate(invalid="ignore"):  # signalling NaN in what is no sweep
        numbers = numbers[:FIRST].astype(np.float64)
    if len(numbers) < FEWEST:
        return assumed
    numbers = np.nan_to_num(numbers, nan=0.0, posinf=0.0, neginf=0.0)
    kinds = np.stack(
        (np.log1p(np.abs(numbers)), np.sign(numbers), (numbers == np.round(numbers)).astype(np.float64)), axis=1
    )
    shares = {period: _explained(kinds, period) for period in {assumed, *PERIODS}}
    best = max(shares.values())
    if shares[assumed] >= 0.7 * best or best - shares[assumed] < 0.1:
        return assumed
    return min(period for period, share in shares.items() if share >= 0.9 * best)


def _explained(kinds: np.ndarray, period: int) -> float:
    """Mean share of the variance of several features that lies between the columns of records of so many numbers."""
    rows = kinds[: len(kinds) // period * period]
    total = rows.var(axis=0)
    between = rows.reshape(-1, period, rows.shape[1]).mean(axis=0).var(axis=0)
    known = total > 1e-9
    return float((between[known] / total[known]).mean()) if known.any() else 0.0


def _implausible(numbers: np.ndarray) -> bool:
    """Tell whether more than a tenth of the numbers cannot be metres (NaN may be: sensors write it for no return)."""
    sample = numbers[:: max(1, len(numbers) // 2000)]
    with np.errstate(invalid="ignore"):  # signalling NaNs, in bytes that are no float32
        magnitude = np.abs(sample.astype(np.float64))
    wrong = (magnitude > FARTHEST) | ((magnitude < 1e-20) & (magnitude > 0))
    return bool(wrong.sum() > 0.1 * wrong.size)


def _other_columns(content: bytes, columns: int) -> str:
    size = len(content)
    period = repeated_kinds(np.frombuffer(content[: size // 4 * 4], dtype="<f4"), columns)
    fitting = [count for count in range(3, 7) if count != columns and size % (4 * count) == 0]
    fitting = [period] if period in fitting else fitting
    if not fitting:
        return ""
    return f' (for {fitting[-1]} columns give `fields`, such as "{",".join(NAMES[: fitting[-1]])}")'
