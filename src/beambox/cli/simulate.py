"""`beambox simulate OUT`: write a labelled data set of simulated sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["command"]


def command(
    out: Annotated[Path, typer.Argument(help="folder to write, in KITTI's layout")],
    frames: Annotated[int, typer.Option(help="how many sweeps", min=1)] = 100,
    sensor: Annotated[str, typer.Option(help="preset such as hdl64, or a .yaml file")] = "hdl64",
    view: Annotated[str, typer.Option(help="camera (the front camera's view) or full (the whole turn)")] = "camera",
    layout: Annotated[
        str, typer.Option(help="random, kitti:PATH (real layouts) or mixed:PATH (half of each)")
    ] = "random",
    layout_split: Annotated[
        str, typer.Option(help="frames of the layouts' ImageSets to use; all: every frame")
    ] = "train",
    seed: Annotated[int, typer.Option(help="same seed, same data", min=0)] = 0,
    workers: Annotated[int, typer.Option(help="processes", min=1)] = 1,
    val_share: Annotated[float, typer.Option(help="share of the sweeps listed in ImageSets/val.txt")] = 0.1,
) -> None:
    """Simulate labelled LiDAR sweeps. An interrupted or shorter data set is continued by the same command."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from beambox import __version__
    from beambox.simulate import write_dataset

    console = Console(stderr=True)
    console.print(f"beambox {__version__}: {frames} frames of {sensor}, view {view}, layout {layout}, seed {seed}")
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("simulating", total=frames)
        split = None if layout_split == "all" else layout_split
        write_dataset(
            out, frames, sensor, view, layout, seed, workers, val_share, split,
            lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
    console.print(f"wrote {frames} frames to {out}")
