"""`beambox report`: one page that shows where a detector is right and where it fails."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import expect_library
from beambox.cli.options import DeviceOption, PrecisionOption, RangeOption, ViewOption, expect_there, parse_range

if TYPE_CHECKING:
    from beambox.data.source import FrameSource
    from beambox.report.measure import Measured

__all__ = ["command"]


def command(  # noqa: PLR0913, PLR0917  # each is an option of the command line
    given: Annotated[
        str,
        typer.Argument(metavar="MODEL", help="Weights (name, file, folder of a run), or a folder of results."),
    ],
    data: Annotated[Path, typer.Option(help="KITTI or ONCE folder, or the YAML file of one's own data.")],
    split: Annotated[str, typer.Option(help="List of frames: the name of a file in ImageSets.")] = "val",
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write (.html).")] = Path("report.html"),
    against: Annotated[str, typer.Option(metavar="MODEL", help="A second detector or folder, side by side.")] = "",
    numbers: Annotated[
        list[Path] | None, typer.Option(help="Numbers too: .json, .csv or .tex; may be repeated.")
    ] = None,
    pages: Annotated[
        bool, typer.Option("--pages", help="Also write a 3-D page of each frame shown, linked from its pictures.")
    ] = False,
    classes: Annotated[str, typer.Option(help="Classes to score, as Car,Cyclist; the model's where not given.")] = "",
    no_difficulty: Annotated[
        bool, typer.Option("--no-difficulty", help="Score every object, without KITTI's levels.")
    ] = False,
    frames: Annotated[int, typer.Option(min=0, help="Only the first so many frames; 0: all.")] = 0,
    worst: Annotated[int, typer.Option(min=0, help="Pictures of each kind of failure and class.")] = 6,
    range_: RangeOption = "",
    view: ViewOption = "auto",
    batch: Annotated[int, typer.Option(min=1, max=1024, help="Frames in one pass.")] = 1,
    device: DeviceOption = "auto",
    precision: PrecisionOption = "auto",
) -> None:
    """Write one HTML page: AP, curves, calibration, errors, groups, confusion, and the worst failures as pictures.

    Examples:
      beambox report pointpillars-kitti --data kitti --out report.html
      beambox report results --data kitti --against other_results --numbers scores.csv --numbers table.tex

    A folder of results holds one file per frame: .json or .csv of `beambox detect`, or KITTI's .txt.
    """
    expect_library("matplotlib", "plots", "a report")
    expect_there([data])
    for name in (given, against):
        expect_there([], name if not Path(name).is_dir() else "")

    from beambox.data.open_dataset import open_dataset
    from beambox.data.source import SubsetSource
    from beambox.report.build import Options, check_page, measured, write_page
    from beambox.report.tables import check_ending

    check_page(out)
    for path in numbers or ():
        check_ending(path)
    source: FrameSource = open_dataset(data, split)
    if frames:
        source = SubsetSource(source, range(min(frames, len(source))))
    options = Options(
        data=data,
        split=split,
        classes=tuple(name for name in classes.split(",") if name),
        levels=not no_difficulty,
        range=parse_range(range_),
        view=view,
        batch=batch,
        device=device,
        precision=precision,
    )
    all_of: list[Measured] = [measured(name, source, options) for name in (given, against) if name]
    write_page(out, all_of, source, worst, pages, numbers or ())
    print(f"{out}")
