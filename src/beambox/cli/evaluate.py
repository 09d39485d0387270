"""`beambox evaluate`: detect in a labelled data set and score the detections by KITTI's rules."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli.options import (
    ClassesOption,
    DeviceOption,
    IouOption,
    ModelArgument,
    PrecisionOption,
    RangeOption,
    ScoreThresholdOption,
    ViewOption,
    expect_there,
    parse_classes,
    parse_range,
)

if TYPE_CHECKING:
    from beambox.data.source import FrameSource

__all__ = ["command"]


def command(  # noqa: PLR0913, PLR0917  # each is an option of the command line
    model: ModelArgument,
    data: Annotated[Path, typer.Option(help="KITTI or ONCE folder, or the YAML file of one's own data.")],
    split: Annotated[str, typer.Option(help="List of frames: the name of a file in ImageSets.")] = "val",
    classes: ClassesOption = "",
    iou: IouOption = None,
    no_difficulty: Annotated[
        bool, typer.Option("--no-difficulty", help="Every object counts, one AP per class; 3d and bev only.")
    ] = False,
    score_threshold: ScoreThresholdOption = 0.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here.")] = None,
    results: Annotated[Path | None, typer.Option(help="Write KITTI result files into this folder.")] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="Keep detections in this file, frame by frame; what it holds is not detected again."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write a page (.html): curves, errors, the worst failures as pictures.")
    ] = None,
    range_: RangeOption = "",
    view: ViewOption = "auto",
    published: Annotated[
        bool,
        typer.Option("--published", help="ONCE: print the rows of DenNet's Table 3 as well, apart from ours."),
    ] = False,
    batch: Annotated[int, typer.Option(min=1, max=1024, help="Frames in one pass.")] = 1,
    device: DeviceOption = "auto",
    precision: PrecisionOption = "auto",
) -> None:
    """Detect in a labelled data set and score by KITTI's rules, or by ONCE's where the data have its layout.

    Data without a camera have no difficulty levels: every object counts, and each class has one AP. Data of one's own
    are looked at within the range that their YAML file names. After the AP follow the errors of the matched boxes.
    """
    expect_there([data], model)

    from beambox.io import write_json
    from beambox.metrics.rounds import parse_rounds
    from beambox.verbs import evaluate, open_dataset

    rounds = parse_rounds(iou or [])
    if published:
        need_once(open_dataset(data, split))
    scored = evaluate(
        model,
        data,
        split=split,
        classes=parse_classes(classes) or None,
        iou=rounds,
        levels=not no_difficulty,
        score_threshold=score_threshold,
        results=results,
        keep=keep,
        report=report,
        batch_size=batch,
        device=device,
        precision=precision,
        range=parse_range(range_),
        view=view,  # pyright: ignore[reportArgumentType]  # load checks it
    )
    print(scored.table(Path(model).stem, published))
    if json_file is not None:
        write_json(json_file, scored.to_json(), indent=2)


def need_once(source: FrameSource) -> None:
    """Refuse --published where the data are not ONCE's.

    Raises:
        BeamboxError: saying so.
    """
    from beambox.data.once import OnceSource

    if not isinstance(source, OnceSource):
        raise BeamboxError("--published prints the rows of a table on ONCE; these data are not of ONCE's layout")
