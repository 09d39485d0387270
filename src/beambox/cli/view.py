"""`beambox view`: sweeps in the rerun viewer, live or as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli import options
from beambox.cli.console import progress, show_log
from beambox.cli.detector_options import DetectorOptions, takes_detector_options

__all__ = ["command"]


@takes_detector_options
def command(  # each is an option of the command line
    inputs: Annotated[
        list[str],
        typer.Argument(metavar="INPUT", help="Sweeps: files, folders, patterns, recordings; or a data set (YAML)."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write this .rrd file instead of opening the viewer.")
    ] = None,
    model: Annotated[str, typer.Option("--model", "-m", metavar="M", help="Detect with these weights.")] = "",
    results: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Show these detections (json, csv, KITTI).")
    ] = None,
    labels: Annotated[str, typer.Option(metavar="DIR", help="Ground truth in KITTI's format; none shows none.")] = "",
    color: Annotated[str, typer.Option(help="Points by height or intensity.")] = "height",
    split: Annotated[str, typer.Option(help="Of a data set: the list of frames; all of them where not given.")] = "",
    names: Annotated[str, typer.Option(metavar="NAMES", help="Only the sweeps of these names.")] = "",
    frames: Annotated[int, typer.Option(min=0, help="Only the first so many sweeps; 0: all.")] = 0,
    rate: Annotated[float, typer.Option(help="Sweeps per second of the time line.")] = 10.0,
    score_threshold: options.ScoreThresholdOption = 0.3,
    *,
    how: DetectorOptions,
) -> None:
    """Open sweeps in rerun (extra `rerun`): points, boxes with scores, camera, ground truth, a time line.

    Examples:
      beambox view drive --model pointpillars-sim
      beambox view drive.mcap --model pointpillars-sim --out drive.rrd

    With a model, sweeps appear as they are detected in, with the network's class scores in BEV.
    """
    from beambox.cli import show_inputs
    from beambox.cli.show import check_choices, check_rate, found_in, truth_of

    check_choices(color, model, results)
    check_rate(rate)
    options.expect_there(inputs, model)

    from beambox.infer.score_map import detect_with_scores
    from beambox.visualize.rerun_log import RerunLog, import_rerun

    show_log()
    import_rerun()
    source = show_inputs.data_set_of(inputs, split)
    sweeps = show_inputs.sweeps_of(
        inputs, source, names, frames, fields=how.fields, intensity_scale=how.intensity_scale, labels=not labels
    )
    detector = show_inputs.detector_for(model, source, **how.for_load())
    log = RerunLog(out, color_by="height" if color == "height" else "intensity")
    for number, sweep in enumerate(progress(sweeps, len(sweeps), "Detecting" if model else "Reading")):
        read, scores = sweep.read(), None
        truth = truth_of(read, labels)
        if detector is None:
            detections = found_in(read, None, results)
        else:
            detections, scores = detect_with_scores(detector, read)
        if detections is not None:
            detections = detections.above(score_threshold)
        log.add(read, detections, truth, scores=scores, seconds=number / rate)
    print(f"{log.close()} sweeps -> {out or 'the viewer'}")
