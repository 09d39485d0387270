"""`beambox bench`: how long detection takes, stage by stage."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from beambox.checks import BeamboxError, did_you_mean
from beambox.cli import options
from beambox.cli.console import announce, log, show_log

__all__ = ["command"]


def command(
    model: options.ModelArgument,
    inputs: Annotated[
        list[str] | None, typer.Argument(metavar="[INPUT]...", help="Sweeps; one simulated if none.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, help="Passes that count.")] = 50,
    warmup: Annotated[int, typer.Option(min=0, help="Passes before them.")] = 20,
    batch: Annotated[int, typer.Option(min=1, max=1024, help="Sweeps in one pass.")] = 1,
    threads: Annotated[int, typer.Option(min=0, max=1024, help="Threads of the CPU; 0 leaves torch's choice.")] = 0,
    protocol: Annotated[
        str, typer.Option(help="stages, or kassd: three parts, mean of ten runs, as in its Table 7.")
    ] = "stages",
    json_file: Annotated[Path | None, typer.Option("--json", metavar="F", help="Write the numbers here.")] = None,
    config: Annotated[
        bool,
        typer.Option("--config", help="MODEL is a detector's name, or a recipe: time it untrained, as configured."),
    ] = False,
    range_: options.RangeOption = "",
    device: options.DeviceOption = "auto",
    precision: options.PrecisionOption = "auto",
) -> None:
    """Measure latency: load, voxelise, network, post-process; percentiles, throughput, peak memory.

    Examples:
      beambox bench pointpillars-sim
      beambox bench run/best.safetensors kitti/training/velodyne/000008.bin --threads 2 --json bench.json
      beambox bench pointpillars-sim --protocol kassd
      beambox bench kassd --config --protocol kassd
    """
    options.expect_there(inputs or [], "" if config else model)
    if protocol not in ("stages", "kassd"):
        raise BeamboxError(f'unknown protocol "{protocol}"{did_you_mean(protocol, ["stages", "kassd"])}')

    import json
    import tempfile

    import torch

    from beambox.infer.benchmark import measure, untrained
    from beambox.infer.inputs import find_sweeps
    from beambox.infer.predictor import load
    from beambox.io import write_text

    show_log()
    if threads:
        torch.set_num_threads(threads)
    if config and range_:
        raise BeamboxError("--range is for trained weights; with --config, give a recipe with the wanted grid")
    if config:
        detector = untrained(model, device=device, precision=precision)
    else:
        detector = load(model, device=device, precision=precision, range=options.parse_range(range_))
    announce("bench", detail=model, seed=None if inputs else 0)
    with tempfile.TemporaryDirectory() as folder:
        paths = [sweep.path for sweep in find_sweeps(inputs)] if inputs else [simulated_sweep(Path(folder))]
        if protocol == "kassd":
            runs, batch = 10, 1
        report = measure(detector, paths, runs=runs, warmup=warmup, batch=batch, name=model)
    settings = report.setting
    print(
        f"{model} on {settings['device']}, {settings['precision']}, {settings['threads']} threads, "
        f"batch {settings['batch']}, {settings['points']:,} points, {settings['runs']} runs after {settings['warmup']}"
    )
    if config:
        print("untrained weights: hardly any box is found, so post-processing is shorter than it will be")
    print(report.kassd_table() if protocol == "kassd" else report.table())
    load_average, cores = settings["load_average"], os.cpu_count() or 1
    if load_average is not None and load_average > 0.5 * cores:
        log(f"the machine was busy (load {load_average} on {cores} cores): these times are too long")
    if json_file is not None:
        write_text(json_file, json.dumps(report.to_json(), indent=2) + "\n")


def simulated_sweep(folder: Path) -> Path:
    """Simulate a sweep of the front view and write it with its calibration."""
    from beambox.data.kitti import write_kitti_frame
    from beambox.simulate import simulate_frame

    frame = simulate_frame(0, 0)
    write_kitti_frame(folder, frame)
    return folder / "training" / "velodyne" / f"{frame.id}.bin"
