"""What scoring by KITTI's rules gives: numbers with their protocol, as JSON and as a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from beambox.structures.rows import frame_of_rows

if TYPE_CHECKING:
    import pandas

__all__ = ["AveragePrecision", "ClassResult", "KittiResult"]

Levels = dict[str, list[float | None]]


@dataclass(frozen=True)
class AveragePrecision:
    """One precision-recall curve and its averages; NaN where there is no object, or no heading, to score."""

    r40: float
    """Percent, over recalls 1/40 to 40/40 (official since October 2019)."""
    r11: float
    """Percent, over recalls 0/10 to 10/10 (official before)."""
    all_points: float
    """Percent, area under the interpolated curve over every recall that occurs."""
    curve: tuple[float, ...]
    """Interpolated precision, in [0, 1], at the 41 recalls."""

    @classmethod
    def unknown(cls) -> AveragePrecision:
        """Nothing to score."""
        return cls(math.nan, math.nan, math.nan, ())


@dataclass(frozen=True)
class ClassResult:
    """Averages of one class, one entry a difficulty level."""

    name: str
    iou: float
    """A detection matches where its IoU is greater."""
    objects: tuple[int, ...]
    """Number of ground-truth boxes that count."""
    box3d: tuple[AveragePrecision, ...]
    """By 3-D IoU."""
    bev: tuple[AveragePrecision, ...]
    """By the IoU in BEV."""
    image: tuple[AveragePrecision, ...] = ()
    """By the IoU in the image; empty without a camera."""
    orientation: tuple[AveragePrecision, ...] = ()
    """AOS: average orientation similarity, bounded by the AP in the image; empty without a camera."""
    labeled: int = 0
    """Ground-truth boxes of the class, whether they count at a level or not."""

    def metrics(self) -> list[tuple[str, tuple[AveragePrecision, ...]]]:
        """Return (name, averages) of the metrics that were computed."""
        named = (("3d", self.box3d), ("bev", self.bev), ("2d", self.image), ("aos", self.orientation))
        return [(name, averages) for name, averages in named if averages]


@dataclass(frozen=True)
class KittiResult:
    """Averages of every class, with the protocol they were computed by."""

    classes: tuple[ClassResult, ...]
    levels: tuple[str, ...]
    """Names of the difficulty levels."""
    frames: int
    """Number of frames scored."""
    python_port: bool = False
    """Whether the rule of the Python port was followed where it differs from the official program."""

    def __getitem__(self, name: str) -> ClassResult:
        """Return the averages of a class."""
        return next(result for result in self.classes if result.name == name)

    def to_json(self) -> dict[str, dict[str, float | Levels]]:
        """Return numbers ready for ``json.dump``, in percent; null where nothing could be scored."""
        return {
            result.name: {
                "iou": result.iou,
                **{
                    name: {
                        "R40": _numbers([a.r40 for a in averages]),
                        "R11": _numbers([a.r11 for a in averages]),
                        "all": _numbers([a.all_points for a in averages]),
                    }
                    for name, averages in result.metrics()
                },
            }
            for result in self.classes
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one flat record per class, metric and level: AP in percent, NaN where nothing could be scored."""
        return [
            {
                "class": result.name, "iou": result.iou, "metric": name, "level": level, "objects": count,
                "R40": one.r40, "R11": one.r11, "all": one.all_points,
            }
            for result in self.classes
            for name, averages in result.metrics()
            for level, count, one in zip(self.levels, result.objects, averages)
        ]  # fmt: skip

    def to_pandas(self) -> pandas.DataFrame:
        """Return the records of :meth:`to_rows` as a table (needs pandas)."""
        return frame_of_rows(self.to_rows(), ("class", "iou", "metric", "level", "objects", "R40", "R11", "all"))

    def __str__(self) -> str:
        """Return the numbers as text, as :meth:`table` does."""
        return self.table()

    def table(self) -> str:
        """Return the numbers as text, with the protocol above them."""
        rule = "rule of the Python port" if self.python_port else "official rule"
        lines = [
            f"KITTI AP in percent, {self.frames} frames, {rule}; columns: {', '.join(self.levels)}",
            *_advice(len(self.levels) > 1),
        ]
        columns = max(21, 7 * len(self.levels))
        for result in self.classes:
            counts = " / ".join(map(str, result.objects))
            lines.append("")
            lines.append(f"{result.name}, IoU > {result.iou:.2f}, {counts} objects")
            lines.append("     " + "".join(title.rjust(columns + 2) for title in ("R40", "R11", "all")))
            for name, averages in result.metrics():
                blocks = ([a.r40 for a in averages], [a.r11 for a in averages], [a.all_points for a in averages])
                lines.append(f"{name:<5}" + "".join(_cells(block).rjust(columns + 2) for block in blocks))
            if not max(result.objects):
                lines.append(f"     {_nothing_counts(result)}")
            elif min(result.objects) < 41:
                lines.append(f"     fewer than 41 objects: R40 and R11 of {result.name} are capped, read `all`")
        return "\n".join(lines) + "\n"


def _nothing_counts(result: ClassResult) -> str:
    if not result.labeled:
        return f"the labels have no {result.name}"
    return (
        f"the labels have {result.labeled} {result.name}, but none that KITTI's levels count (an image box of 25 "
        "pixels or more, seen well enough): --no-difficulty counts every object"
    )


def _advice(graded: bool) -> list[str]:
    if not graded:
        return [
            "every object counts, no difficulty levels; 3d and bev are IoU in 3-D and in BEV",
            "R40, R11: official 40 and 11 recalls; all: every recall, to be read where a class has few objects",
        ]
    return [
        "papers quote 3d, moderate (the middle number): R40 since October 2019, R11 before; the two do not compare",
        "all: area over every recall; read it on sets with few objects, where R40 and R11 cannot reach 100",
    ]


def _numbers(values: Sequence[float]) -> list[float | None]:
    return [None if math.isnan(value) else round(value, 4) for value in values]


def _cells(values: Sequence[float]) -> str:
    return "".join(("-" if math.isnan(value) else f"{value:.2f}").rjust(7) for value in values)
