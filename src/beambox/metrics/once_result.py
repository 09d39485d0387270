"""What scoring by ONCE's rules gives, as JSON and in the layout of DenNet's Table 3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from beambox.structures.rows import frame_of_rows

if TYPE_CHECKING:
    import pandas

__all__ = ["BANDS", "PUBLISHED", "OnceResult", "PublishedRow"]

BANDS = ("overall", "0-30m", "30-50m", "50m-inf")
"""Bands of distance from the sensor."""


@dataclass(frozen=True)
class OnceResult:
    """AP of every class and band, percent."""

    classes: tuple[str, ...]
    iou: tuple[float, ...]
    """Threshold of each class."""
    ap: tuple[tuple[float, ...], ...]
    """A row per class, a column per band."""
    objects: tuple[tuple[int, ...], ...]
    """Number of ground-truth boxes that count, likewise."""
    frames: int
    """Number of frames scored."""
    whole: bool = True
    """Whether all the benchmark's classes were scored, so that the mean is its mAP."""
    unknown: tuple[str, ...] = ()
    """Names, with what to do, of boxes left out because ONCE has no such class."""

    def mean(self) -> tuple[float, ...]:
        """Return the plain mean over the classes scored, one value per band; of all classes the first is the mAP."""
        return tuple(sum(column) / len(column) for column in zip(*self.ap))

    def to_json(self) -> dict[str, dict[str, float]]:
        """Return numbers ready for ``json.dump``, in percent; the mean only where it is that of all classes."""

        def bands(row: Sequence[float]) -> dict[str, float]:
            return dict(zip(BANDS, (round(value, 4) for value in row)))

        entries = {name: {"iou": iou, **bands(row)} for name, iou, row in zip(self.classes, self.iou, self.ap)}
        return {**entries, "mean": bands(self.mean())} if self.whole else entries

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one flat record per class and band of distance: AP in percent."""
        return [
            {"class": name, "iou": iou, "band": band, "objects": count, "AP": value}
            for name, iou, counts, row in zip(self.classes, self.iou, self.objects, self.ap)
            for band, count, value in zip(BANDS, counts, row)
        ]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the records of :meth:`to_rows` as a table (needs pandas)."""
        return frame_of_rows(self.to_rows(), ("class", "iou", "band", "objects", "AP"))

    def __str__(self) -> str:
        """Return the numbers as text, as :meth:`table` does."""
        return self.table()

    def table(self, name: str = "this result", published: bool = False) -> str:
        """Return the numbers as text, in the layout of DenNet's Table 3.

        Args:
            name: of the row.
            published: add the paper's rows in a block of their own; only for the three merged classes.
        """
        rule = ", ".join(f"{each} > {value:.2f}" for each, value in zip(self.classes, self.iou))
        lines = [
            f"ONCE AP in percent, {self.frames} frames; 3-D IoU {rule}, headings within 90 degrees",
            "papers quote mAP, the mean of the `overall` columns",
            "",
            *_head(self.classes),
            _line(name, [*self.ap], self.mean()[0]),
        ]
        empty = [
            f"{each} {band}"
            for each, row in zip(self.classes, self.objects)
            for band, number in zip(BANDS, row)
            if number == 0
        ]
        if empty:
            lines += ["", f"no objects, scored 0 by the official rule: {', '.join(empty)}"]
        if self.unknown:
            lines += ["", f"left out, ONCE has no such class: {'; '.join(self.unknown)}"]
        if published and len(self.classes) == 3:
            lines += [
                "",
                "published on ONCE val, copied from DenNet (Photonics 2022), Table 3; not measured here",
                *_head(self.classes),
                *(_line(row.name, [row.vehicle, row.pedestrian, row.cyclist], row.mean) for row in PUBLISHED),
                "(DenNet prints a mAP of 60.31 where the mean of its own columns is 60.50)",
            ]
        return "\n".join(lines) + "\n"


def _head(classes: Sequence[str]) -> list[str]:
    columns = "".join(title.rjust(8) for title in ("overall", "0-30", "30-50", ">50"))
    return [
        " " * 14 + "".join(f" |{name:^32}" for name in classes),
        " " * 14 + f" |{columns}" * len(classes) + " |    mAP",
    ]


def _line(name: str, groups: Sequence[Sequence[float]], mean: float) -> str:
    return f"{name:<14}" + "".join(" |" + "".join(f"{v:8.2f}" for v in group) for group in groups) + f" |{mean:7.2f}"


class PublishedRow(NamedTuple):
    """A row of the paper's table: four bands a class, and the mean as printed."""

    name: str
    vehicle: tuple[float, float, float, float]
    pedestrian: tuple[float, float, float, float]
    cyclist: tuple[float, float, float, float]
    mean: float


PUBLISHED = (
    PublishedRow(
        "PointPillars", (68.57, 80.86, 62.07, 47.04), (17.63, 19.74, 15.15, 10.23), (46.81, 58.33, 40.32, 25.86), 44.34
    ),
    PublishedRow(
        "SECOND", (71.19, 84.04, 63.02, 47.25), (26.44, 29.33, 24.05, 18.05), (58.04, 69.96, 52.43, 34.61), 51.89
    ),
    PublishedRow(
        "CenterPoints", (66.79, 80.10, 59.55, 43.39), (49.90, 56.24, 42.61, 26.27), (63.45, 74.28, 57.94, 41.48), 60.05
    ),
    PublishedRow(
        "PV-RCNN", (77.77, 89.39, 72.55, 58.64), (23.50, 25.61, 22.84, 17.27), (59.37, 71.66, 52.58, 36.17), 53.55
    ),
    PublishedRow(
        "PointRCNN", (52.09, 74.45, 40.89, 16.81), (4.28, 6.17, 2.40, 0.91), (29.84, 46.03, 20.94, 5.46), 28.74
    ),
    PublishedRow(
        "IA-SSD", (70.30, 83.01, 62.84, 47.01), (39.82, 47.45, 32.75, 18.99), (62.17, 73.78, 56.31, 39.53), 57.43
    ),
    PublishedRow(
        "Voxel R-CNN", (73.53, 87.07, 65.59, 49.97), (35.66, 42.38, 29.80, 18.15), (59.85, 73.57, 51.59, 33.65), 56.35
    ),
    PublishedRow(
        "DenNet", (80.24, 89.88, 73.57, 60.49), (35.68, 41.72, 32.88, 18.79), (65.59, 77.77, 57.60, 41.24), 60.31
    ),
)
"""DenNet, Table 3: AP on ONCE val, percent."""
