"""The tables that `beambox ablate` trains again, as data: switches and published numbers of each row.

Switches are options of the detector on top of the recipe's; a row without them is quoted from the paper, not trained.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from beambox.checks import BeamboxError, MissingFileError, did_you_mean

__all__ = ["TABLES", "Column", "Row", "Table", "levels", "read_table", "table_of"]

LEVELS = ("easy", "moderate", "hard")


@dataclass(frozen=True)
class Column:
    """One number of every row."""

    group: str
    """Metric with its protocol, such as ``Car 3-D R11``."""
    name: str
    """Its part, such as ``moderate``."""
    path: tuple[str | int, ...]
    """Where the number stands in what scoring gives (``to_json()``), such as ``("Car", "3d", "R11", 1)``."""


def levels(name: str, metric: str, recalls: str) -> tuple[Column, ...]:
    """Return KITTI's three columns of a class: easy, moderate, hard.

    Args:
        name: of the class.
        metric: ``3d``, ``bev``, ``2d`` or ``aos``.
        recalls: ``R11`` or ``R40``.
    """
    title = {"3d": "3-D", "bev": "BEV", "2d": "2-D", "aos": "AOS"}[metric]
    return tuple(
        Column(f"{name} {title} {recalls}", level, (name, metric, recalls, i)) for i, level in enumerate(LEVELS)
    )


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    name: str
    """As the paper calls it."""
    published: tuple[float | None, ...]
    """The paper's number of each column; None where it has none."""
    options: Mapping[str, Any] | None = None
    """Switches: what the detector's options are beyond the recipe's. None for a row that is quoted and not trained."""


@dataclass(frozen=True)
class Table:
    """A table of a paper."""

    title: str
    """Paper, number and what is compared."""
    protocol: str
    """What the paper's numbers were measured on."""
    recipe: str
    """Name of the shipped recipe of every row."""
    columns: tuple[Column, ...]
    """What is measured."""
    rows: tuple[Row, ...]
    """In the paper's order."""
    remarks: tuple[str, ...] = ()
    """What a reader of the paper's numbers should know."""

    def __post_init__(self) -> None:
        for row in self.rows:
            assert len(row.published) == len(self.columns), f"{self.title}, {row.name}: a number for each column"


def keypoints(m: int, n: int, d: int, e: int) -> dict[str, Any]:
    """Return KASSD's switches for other keypoints, without LLM, as its table 6."""
    return {"llm": False, "keypoints": {"m": m, "n": n, "d": d, "e": e}}


CAR_3D_R11 = levels("Car", "3d", "R11")
HCNET_VAL = "KITTI validation split, cars, IoU 0.7; R11 is not stated, but the baselines it copies are R11"
KASSD_VAL = "KITTI validation split, cars, IoU 0.7, R11"
SECOND_BACKBONE = {"llm": False}
KASSD_BASELINE = {"llm": False, "kam": False}

TABLES: dict[str, Table] = {
    "dennet-table4": Table(
        title="DenNet, table 4: its three modules",
        protocol="ONCE validation split, AP over all distances; device and protocol of the times are not stated",
        recipe="dennet-once",
        columns=(
            *(Column(f"ONCE {name}", "overall", (name, "overall")) for name in ("Vehicle", "Pedestrian", "Cyclist")),
            Column("ONCE mAP", "overall", ("mean", "overall")),
            Column("time", "ms", ("time", "ms")),
        ),
        rows=(
            Row("Voxel R-CNN", (73.53, 35.66, 59.85, 56.35, 27.72), {"vda": False, "na": False, "ca": False}),
            Row("VDA", (78.82, 28.94, 61.24, 55.89, 32.99), {"na": False, "ca": False}),
            Row("VDA + NA", (79.94, 32.28, 64.35, 58.86, 34.68), {"ca": False}),
            Row("VDA + NA + CA", (80.24, 35.68, 65.59, 60.31, 35.56), {}),
        ),
        remarks=(
            "mAP as printed; the means of the printed classes are 56.35, 56.33, 58.86 and 60.50",
            "ours: time is the median of one sweep at a time, from points to boxes, without reading files",
        ),
    ),
    "hcnet-table1": Table(
        title="HCNet, table 1: 3-D detection on the validation split",
        protocol=HCNET_VAL,
        recipe="hcnet-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("VoxelNet", (81.97, 65.46, 62.85)),
            Row("SECOND", (85.50, 75.04, 68.78)),
            Row("PointPillars", (87.50, 77.01, 74.77)),
            Row("PointRCNN", (88.26, 77.73, 76.67)),
            Row("HCNet", (88.45, 78.01, 76.72), {}),
        ),
    ),
    "hcnet-table2": Table(
        title="HCNet, table 2: from above, in 3-D, and orientation",
        protocol="KITTI test server, cars, IoU 0.7; HCNet's own row (late 2021) is R40, the others are older, R11",
        recipe="hcnet-kitti-car",
        columns=(*levels("Car", "bev", "R40"), *levels("Car", "3d", "R40"), *levels("Car", "aos", "R40")),
        rows=(
            Row("VoxelNet", (89.35, 79.26, 77.39, 77.47, 65.11, 57.73, None, None, None)),
            Row("SECOND", (88.07, 79.37, 77.95, 83.13, 73.66, 66.20, 87.84, 81.31, 71.85)),
            Row("PointPillars", (88.35, 86.10, 79.83, 79.05, 74.99, 68.30, 90.19, 88.76, 86.38)),
            Row("PointRCNN", (89.28, 86.04, 79.02, 84.32, 75.42, 67.86, 90.76, 89.55, 80.76)),
            Row("SARPNET", (88.93, 87.26, 78.68, 84.92, 75.64, 67.70, 90.16, 88.86, 80.05)),
            Row("HCNet", (90.27, 86.91, 81.90, 81.31, 73.56, 68.42, 95.05, 91.44, 88.02), {}),
        ),
        remarks=("AOS is bounded by the AP in the image, not by the one from above",),
    ),
    "hcnet-table3": Table(
        title="HCNet, table 3: which attention weighs the pseudo images",
        protocol=HCNET_VAL,
        recipe="hcnet-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("none", (None, None, None), {"attention": "none"}),
            Row("CA", (87.22, 77.33, 75.78), {"attention": "CA"}),
            Row("HA", (87.19, 77.26, 75.82), {"attention": "HA"}),
            Row("HCA", (88.45, 78.01, 76.72), {}),
        ),
        remarks=("`none`, a plain maximum over the slices, is not in the paper",),
    ),
    "hcnet-table4": Table(
        title="HCNet, table 4: parts of the head",
        protocol=HCNET_VAL,
        recipe="hcnet-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("neither", (None, None, None), {"oifm": False, "aam": False}),
            Row("AAM", (87.23, 77.33, 75.70), {"oifm": False}),
            Row("OIFM", (88.32, 78.08, 76.52), {"aam": False}),
            Row("AAM + OIFM", (88.45, 78.01, 76.72), {}),
        ),
        remarks=("`neither` is not in the paper",),
    ),
    "kassd-table3": Table(
        title="KASSD, table 3: a campus seen by a 32-beam LiDAR",
        protocol="the paper's own 500 frames (WHUT), cars, IoU 0.7, R11, no difficulty levels; never published",
        recipe="kassd-whut",
        columns=(Column("Car 3-D R11", "all objects", ("Car", "3d", "R11", 0)),),
        rows=(
            Row("SECOND", (72.31,), {"llm": False, "kam": False, "swapped": True}),
            Row("KASSD", (73.28,), {}),
        ),
        remarks=(
            "SECOND is KASSD without its two modules, with SECOND's weights of the losses (class 1, box 2)",
            "other data, real or simulated, says only whether the order holds",
        ),
    ),
    "kassd-table4": Table(
        title="KASSD, table 4: its two modules",
        protocol=KASSD_VAL,
        recipe="kassd-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("neither", (89.09, 78.95, 77.67), KASSD_BASELINE),
            Row("LLM", (89.41, 79.35, 77.94), {"kam": False}),
            Row("KAM", (89.94, 79.84, 78.82), SECOND_BACKBONE),
            Row("LLM + KAM", (90.14, 80.06, 78.91), {}),
        ),
        remarks=("`neither` is SECOND's network with KASSD's weights of the losses",),
    ),
    "kassd-table5": Table(
        title="KASSD, table 5: other modules in place of LLM",
        protocol=KASSD_VAL,
        recipe="kassd-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("PSA", (90.14, 79.61, 78.35), {"neck": "psa"}),
            Row("DenseASPP", (89.74, 79.12, 78.08), {"neck": "denseaspp"}),
            Row("SPP", (89.62, 79.42, 78.32), {"neck": "spp"}),
            Row("LLM", (90.14, 80.06, 78.91), {}),
        ),
        remarks=("DenseASPP and SPP stand inside LLM, at half resolution; PSA replaces it",),
    ),
    "kassd-table6": Table(
        title="KASSD, table 6: keypoints on the border and inside",
        protocol=KASSD_VAL,
        recipe="kassd-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("0 and 0", (89.09, 78.95, 77.67), KASSD_BASELINE),
            Row("4 and 0", (89.42, 79.30, 78.15), keypoints(2, 2, 0, 0)),
            Row("18 and 0", (89.65, 79.45, 78.31), keypoints(6, 5, 0, 0)),
            Row("28 and 0", (89.62, 79.42, 78.32), keypoints(9, 7, 0, 0)),
            Row("0 and 11", (89.89, 79.76, 78.45), keypoints(0, 0, 6, 3)),
            Row("18 and 13", (89.94, 79.84, 78.82), SECOND_BACKBONE),
            Row("28 and 19", (89.66, 79.32, 78.43), keypoints(9, 7, 7, 4)),
        ),
        remarks=("without LLM: the first row and the one of 18 and 13 are table 4's",),
    ),
    "kassd-weights": Table(
        title="KASSD, weights of the losses: as printed, and as every relative has them",
        protocol=KASSD_VAL,
        recipe="kassd-kitti-car",
        columns=CAR_3D_R11,
        rows=(
            Row("class 2, box 1", (90.14, 80.06, 78.91), {}),
            Row("class 1, box 2", (None, None, None), {"swapped": True}),
        ),
        remarks=("not a table of the paper: section 4.2 names the weights without saying which is whose",),
    ),
}


class TableFile(BaseModel):
    """A table of one's own, as its YAML file has it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    recipe: str
    rows: dict[str, dict[str, Any]] = Field(min_length=1)
    classes: list[str] = Field(min_length=1)
    metric: Literal["3d", "bev", "2d", "aos"] = "3d"
    recalls: Literal["R40", "R11"] = "R40"


def read_table(path: Path) -> Table:
    """Read a table of one's own: rows by name, each with the options of the detector that it switches.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: naming the key that is wrong.
    """
    if not path.is_file():
        raise MissingFileError(f"--table: there is no file {path}")
    try:
        given = TableFile.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise BeamboxError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    except ValidationError as error:
        faults = [f"{'.'.join(map(str, one['loc'])) or 'the file'}: {one['msg']}" for one in error.errors()]
        raise BeamboxError(f"{path}: {'; '.join(faults)}") from None
    columns = tuple(column for name in given.classes for column in levels(name, given.metric, given.recalls))
    none = (None,) * len(columns)
    rows = tuple(Row(name, none, options) for name, options in given.rows.items())
    return Table(given.title, "no paper: a table of one's own", given.recipe, columns, rows)


def table_of(name: str) -> Table:
    """Look a table up.

    Raises:
        BeamboxError: naming the nearest one.
    """
    if name not in TABLES:
        raise BeamboxError(f'there is no table "{name}"{did_you_mean(name, TABLES)}')
    return TABLES[name]
