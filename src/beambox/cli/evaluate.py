"""`beambox evaluate`: detect in a labelled data set and score the detections by KITTI's rules."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["command"]


def command(
    model: Annotated[str, typer.Argument(help="Name of shipped weights, a weight file, or the folder of a run.")],
    data: Annotated[Path, typer.Option(help="Data set in KITTI's layout.")],
    split: Annotated[str, typer.Option(help="List of frames: the name of a file in ImageSets.")] = "val",
    classes: Annotated[str | None, typer.Option(help="Classes to score, as Car,Cyclist; default: the model's.")] = None,
    iou: Annotated[
        list[str] | None, typer.Option(help="Score a second time with this overlap, as Car=0.5; may be repeated.")
    ] = None,
    score_threshold: Annotated[float, typer.Option(help="Drop detections with lower scores.")] = 0.0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here.")] = None,
    results: Annotated[Path | None, typer.Option(help="Write KITTI result files into this folder.")] = None,
    full_view: Annotated[
        bool, typer.Option("--full-view", help="Use all points, not only those that the camera sees.")
    ] = False,
    batch: Annotated[int, typer.Option(min=1, help="Frames in one pass.")] = 1,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
) -> None:
    """Detect in a labelled data set and score the detections by KITTI's rules."""
    import json
    import sys

    from rich.console import Console
    from rich.progress import track

    from beambox.infer.evaluate import detector_for, parse_overlaps, score_frames, scored_frames, write_results

    overlaps = parse_overlaps(iou or [])
    detector = detector_for(model, device)
    from beambox.data.kitti import KittiSource

    source = KittiSource(data, split, fov=not full_view)
    console = Console(file=sys.stderr)
    steps = iter(track(range(len(source)), "detecting", console=console, disable=not console.is_terminal))
    frames = scored_frames(
        detector, source, batch=batch, score_threshold=score_threshold, progress=lambda _: next(steps, None)
    )
    if results is not None:
        write_results(results, frames)
    wanted = classes.split(",") if classes else list(detector.config.classes)
    scored = score_frames(frames, wanted)
    print(scored.table())
    numbers: dict[str, object] = dict(scored.to_json())
    if overlaps:
        again = score_frames(frames, wanted, overlaps)
        print(again.table())
        numbers = {"default": numbers, "given": again.to_json()}
    if json_file is not None:
        from beambox.detectors.weights import write_atomically

        write_atomically(json_file, (json.dumps(numbers, indent=2) + "\n").encode())
