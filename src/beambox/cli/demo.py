"""`beambox demo`: the whole chain in under a minute, with nothing but this package."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli import options
from beambox.cli.console import announce, log, show_log

__all__ = ["command"]


def command(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for everything.")] = Path("demo"),
    model: Annotated[str, typer.Option("--model", "-m", metavar="M", help="Weights; a shipped set if none.")] = "",
    frames: Annotated[int, typer.Option(min=1, max=10_000, help="Sweeps to simulate.")] = 6,
    sensor: Annotated[str, typer.Option(help="Simulated sensor.")] = "hdl64",
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Same seed, same sweeps.")] = 2026,
    device: options.DeviceOption = "auto",
) -> None:
    """Simulate a few sweeps, detect with shipped weights, score and draw; leaves pictures and a table in demo/.

    Examples:
      beambox demo
      beambox demo --frames 20 --seed 7 --out more
    """
    from beambox.infer.demo import run_demo, short_table
    from beambox.infer.predictor import load
    from beambox.zoo import DEFAULT, shipped

    show_log()
    start = time.perf_counter()
    name = model or (DEFAULT if DEFAULT in shipped() else "")
    if not name:
        raise BeamboxError("no weights are shipped with this installation; train some and give them by --model")
    announce("demo", seed=seed, detail=name)
    detector = load(name, device=device)
    done = run_demo(detector, out, frames=frames, seed=seed, sensor=sensor, model=name, log=print)
    print()
    print(short_table(done.scores))
    print()
    print(f"pictures: {done.pictures[0].parent}; whole table: {out / 'scores.txt'}; results: {out / 'results'}")
    log(f"{done.objects} objects, {done.detections} found, {time.perf_counter() - start:.0f} s")
