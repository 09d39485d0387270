"""`beambox evaluate`: detect in a labelled data set and score the detections by KITTI's rules."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli.options import DeviceOption, PrecisionOption, ViewOption

__all__ = ["command"]


def command(
    model: Annotated[str, typer.Argument(help="Shipped name, .safetensors file, or folder of a run.")],
    data: Annotated[Path, typer.Option(help="Data set in KITTI's layout.")],
    split: Annotated[str, typer.Option(help="List of frames: the name of a file in ImageSets.")] = "val",
    classes: Annotated[str, typer.Option(help="Classes to score, as Car,Cyclist; the model's where not given.")] = "",
    iou: Annotated[
        list[str] | None, typer.Option(help="Score a second time with this overlap, as Car=0.5; may be repeated.")
    ] = None,
    score_threshold: Annotated[float, typer.Option(help="Drop detections with lower scores.")] = 0.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here.")] = None,
    results: Annotated[Path | None, typer.Option(help="Write KITTI result files into this folder.")] = None,
    view: ViewOption = "auto",
    batch: Annotated[int, typer.Option(min=1, help="Frames in one pass.")] = 1,
    device: DeviceOption = "auto",
    precision: PrecisionOption = "auto",
) -> None:
    """Detect in a labelled data set and score the detections by KITTI's rules."""
    import json

    from beambox.cli.console import progress
    from beambox.data.kitti import KittiSource
    from beambox.detectors.weights import write_atomically
    from beambox.infer.evaluate import detect_frames, parse_overlaps, score_frames, scored_frames, write_results
    from beambox.infer.predictor import load

    overlaps = parse_overlaps(iou or [])
    detector = load(model, device=device, precision=precision, view=view)  # pyright: ignore[reportArgumentType]
    source = KittiSource(data, split)
    found = detect_frames(detector.detect, source, batch=batch, score_threshold=score_threshold)
    frames = scored_frames(progress(found, len(source), "detecting"))
    if results is not None:
        write_results(results, frames)
    wanted = classes.split(",") if classes else list(detector.classes)
    scored = score_frames(frames, wanted)
    print(scored.table())
    numbers: dict[str, object] = dict(scored.to_json())
    if overlaps:
        again = score_frames(frames, wanted, overlaps)
        print(again.table())
        numbers = {"default": numbers, "given": again.to_json()}
    if json_file is not None:
        write_atomically(json_file, (json.dumps(numbers, indent=2) + "\n").encode())
