"""`beambox simulate OUT`: write a labelled data set of simulated sweeps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["command"]


def command(
    out: Annotated[Path, typer.Argument(help="folder to write")],
    frames: Annotated[int, typer.Option(help="how many sweeps", min=1, max=1_000_000)] = 100,
    files: Annotated[
        str,
        typer.Option("--format", help="layout of the files: kitti, or once (whole turns, its axes and five classes)"),
    ] = "kitti",
    sensor: Annotated[
        str, typer.Option(help="preset (hdl64, hdl32, pandar40, pandar64) or .yaml file [hdl64; once: pandar40]")
    ] = "",
    view: Annotated[str, typer.Option(help="camera (what the front camera sees) or full (the whole turn)")] = "",
    layout: Annotated[
        str, typer.Option(help="random, kitti:PATH (real layouts) or mixed:PATH (half of each)")
    ] = "random",
    layout_split: Annotated[
        str, typer.Option(help="frames of the layouts' ImageSets to use; all: every frame")
    ] = "train",
    seed: Annotated[int, typer.Option(help="same seed, same data", min=0, max=2**32 - 1)] = 0,
    workers: Annotated[int, typer.Option(help="processes", min=1, max=1024)] = 1,
    val_share: Annotated[
        float, typer.Option(help="share of the sweeps (once: of the sequences) listed in ImageSets/val.txt")
    ] = 0.1,
    sequence_length: Annotated[int, typer.Option(help="once: sweeps in one sequence", min=1, max=10_000)] = 10,
    compare: Annotated[
        Path | None,
        typer.Option(
            help="folder in KITTI's layout: print where the points of its objects and of ours lie in their boxes"
        ),
    ] = None,
) -> None:
    """Simulate labelled LiDAR sweeps. An interrupted or shorter data set is continued by the same command."""
    from beambox.checks import BeamboxError
    from beambox.cli.options import expect_there

    expect_there([compare])
    from beambox.cli.console import announce, log
    from beambox.verbs import open_dataset, simulate

    if compare and files != "kitti":
        raise BeamboxError(f"--compare reads KITTI's layout, and --format is {files}; leave one of the two out")
    real = open_dataset(compare, "train", camera_view=True) if compare else None  # refused before an hour of work
    details = ", ".join(f"{name} {value}" for name, value in (("sensor", sensor), ("view", view)) if value)
    announce(
        "simulate",
        seed=seed,
        detail=f"{frames} frames in the layout of {files.upper()}, {details + ', ' if details else ''}layout {layout}",
    )
    simulate(
        out,
        frames,
        format=files,
        sensor=sensor or None,
        view=view or None,
        layout=layout,
        layout_split=None if layout_split == "all" else layout_split,
        seed=seed,
        workers=workers,
        val_share=val_share,
        sequence_length=sequence_length,
    )
    log(f"wrote {frames} frames to {out}")
    if real is not None:
        from beambox.simulate.compare import compare_objects

        print(compare_objects(real, open_dataset(out, "train", camera_view=True)).table(), end="")
