"""`beambox evaluate`: detect in a labelled data set and score the detections by KITTI's rules."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beambox.checks import BeamboxError
from beambox.cli.options import (
    ClassesOption,
    DeviceOption,
    IouOption,
    ModelArgument,
    PrecisionOption,
    RangeOption,
    ViewOption,
    parse_classes,
    parse_range,
)

if TYPE_CHECKING:
    from beambox.data.source import FrameSource
    from beambox.infer.predictor import Detector
    from beambox.structures import Detections, Frame

__all__ = ["command"]


def command(  # noqa: PLR0913, PLR0917  # each is an option of the command line
    model: ModelArgument,
    data: Annotated[Path, typer.Option(help="KITTI or ONCE folder, or the YAML file of one's own data.")],
    split: Annotated[str, typer.Option(help="List of frames: the name of a file in ImageSets.")] = "val",
    classes: ClassesOption = "",
    iou: IouOption = None,
    no_difficulty: Annotated[
        bool, typer.Option("--no-difficulty", help="Every object counts, one AP a class; 3d and bev only.")
    ] = False,
    score_threshold: Annotated[float, typer.Option(help="Drop detections with lower scores.")] = 0.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here.")] = None,
    results: Annotated[Path | None, typer.Option(help="Write KITTI result files into this folder.")] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="Keep detections in this file, frame by frame; what it holds is not detected again."),
    ] = None,
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
    are looked at within the range that their YAML file names. After the AP follow the errors of the matched boxes.
    """
    from beambox.cli.console import progress
    from beambox.data.custom import CustomSource
    from beambox.data.custom_config import KITTI_GROUND
    from beambox.data.once import OnceSource
    from beambox.data.opening import open_data
    from beambox.infer.evaluate import check_classes, evaluate_frames, scored_frames
    from beambox.infer.predictor import load
    from beambox.io import write_json
    from beambox.metrics.rounds import parse_rounds

    rounds = parse_rounds(iou or [])
    source = open_data(data, split)
    by_once = isinstance(source, OnceSource)
    if published and not by_once:
        raise BeamboxError("--published prints the rows of a table on ONCE; these data are not of ONCE's layout")
    if results is not None and source[0].calibration is None:
        raise BeamboxError(
            "--results writes KITTI result files, whose boxes live in a camera's frame, and the data have no "
            "calibration; keep the detections with --keep FILE"
        )
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
    wanted = parse_classes(classes) or list(detector.classes)
    check_classes(wanted, rounds, by_once)
    found = _found(detector, model, source, data, keep, batch, score_threshold)
    frames = scored_frames(progress(_written(found, results), len(source), "detecting"))
    scored = evaluate_frames(
        frames,
        wanted,
        rounds,
        by_once=by_once,
        levels=not no_difficulty,
        precision=str(detector.dtype).removeprefix("torch."),
    )
    print(scored.table(Path(model).stem, published))
    if json_file is not None:
        write_json(json_file, scored.to_json(), indent=2)


def _found(
    detector: Detector, model: str, source: FrameSource, data: Path, keep: Path | None, batch: int, threshold: float
) -> Iterator[tuple[Frame, Detections]]:
    """Detect, or take what was kept."""
    from beambox.infer.evaluate import detect_frames
    from beambox.infer.kept import KeptDetections, digest
    from beambox.infer.predictor import find_weights

    if keep is None:
        return detect_frames(detector.detect, source, batch=batch, score_threshold=threshold)
    made_by: dict[str, Any] = {
        "model": Path(model).name,
        "weights": digest(find_weights(model)),
        "data": str(data.resolve()),
        "precision": str(detector.dtype).removeprefix("torch."),
        "range": [list(detector.grid.minimum), list(detector.grid.maximum)],
        "view": detector.view,
        "raised": detector.corrections.raise_by,
        "score_threshold": threshold,
    }
    kept = KeptDetections(keep, made_by, detector.classes)
    return kept.detect(detector.detect, source, batch=batch, score_threshold=threshold)


def _written(found: Iterator[tuple[Frame, Detections]], folder: Path | None) -> Iterator[tuple[Frame, Detections]]:
    """Write each frame's KITTI result file as soon as it is there."""
    from beambox.infer.evaluate import write_result

    for frame, detections in found:
        if folder is not None:
            write_result(folder, frame, detections)
        yield frame, detections
