"""`beambox evaluate`: detect in a labelled data set and score the detections by KITTI's rules."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli.options import DeviceOption, ModelArgument, PrecisionOption, RangeOption, ViewOption, parse_range

__all__ = ["command"]


def command(  # noqa: PLR0913, PLR0917  # each is an option of the command line
    model: ModelArgument,
    data: Annotated[Path, typer.Option(help="KITTI or ONCE folder, or the YAML file of one's own data.")],
    split: Annotated[str, typer.Option(help="List of frames: the name of a file in ImageSets.")] = "val",
    classes: Annotated[str, typer.Option(help="Classes to score, as Car,Cyclist; the model's where not given.")] = "",
    iou: Annotated[
        list[str] | None, typer.Option(help="Score a second time with this overlap, as Car=0.5; may be repeated.")
    ] = None,
    score_threshold: Annotated[float, typer.Option(help="Drop detections with lower scores.")] = 0.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here.")] = None,
    results: Annotated[Path | None, typer.Option(help="Write KITTI result files into this folder.")] = None,
    range_: RangeOption = "",
    view: ViewOption = "auto",
    published: Annotated[
        bool,
        typer.Option("--published", help="ONCE: print the rows of DenNet's Table 3 as well, apart from ours."),
    ] = False,
    batch: Annotated[int, typer.Option(min=1, help="Frames in one pass.")] = 1,
    device: DeviceOption = "auto",
    precision: PrecisionOption = "auto",
) -> None:
    """Detect in a labelled data set and score by KITTI's rules, or by ONCE's where the data have its layout.

    Data without a camera have no difficulty levels: every object counts, and each class has one AP. Data of one's own
    are looked at within the range that their YAML file names.
    """
    from beambox.cli.console import progress
    from beambox.data.custom import CustomSource
    from beambox.data.custom_config import KITTI_GROUND
    from beambox.data.once import OnceSource
    from beambox.data.opening import open_data
    from beambox.infer.evaluate import (
        detect_frames,
        parse_overlaps,
        score_frames,
        score_once,
        scored_frames,
        write_results,
    )
    from beambox.infer.predictor import load
    from beambox.io import write_json

    overlaps = parse_overlaps(iou or [])
    source = open_data(data, split)
    region, height = parse_range(range_), None
    if isinstance(source, CustomSource):
        region = region or source.config.range
        height = None if source.config.sensor_height is None else -KITTI_GROUND
    detector = load(
        model,
        device=device,
        precision=precision,
        view=view,  # pyright: ignore[reportArgumentType]
        range=region,
        sensor_height=height,
    )
    found = detect_frames(detector.detect, source, batch=batch, score_threshold=score_threshold)
    frames = scored_frames(progress(found, len(source), "detecting"))
    if results is not None:
        write_results(results, frames)
    wanted = classes.split(",") if classes else list(detector.classes)
    tables = []
    for thresholds in [None, overlaps] if overlaps else [None]:
        if isinstance(source, OnceSource):
            scored = score_once(frames, thresholds)
            print(scored.table(Path(model).stem, published))
        else:
            scored = score_frames(frames, wanted, thresholds)
            print(scored.table())
        tables.append(scored.to_json())
    numbers = {"default": tables[0], "given": tables[1]} if overlaps else tables[0]
    if json_file is not None:
        write_json(json_file, numbers, indent=2)
