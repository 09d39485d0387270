"""`beambox setup`: make the machine code that is otherwise made at first use."""

from __future__ import annotations

import logging
from typing import Annotated

import typer

from beambox.cli import options

__all__ = ["command"]


def command(
    device: options.DeviceOption = "auto",
    no_training: Annotated[bool, typer.Option("--no-training", help="Only what detecting needs.")] = False,
) -> None:
    """Compile kernels for this machine ahead of time, so that the first detection is as fast as any.

    Examples:
      beambox setup
      beambox setup --no-training

    Kernels are made by numba (CPU) or Triton (GPU) when they are first used and kept on disk; this uses each of them
    once, on a simulated sweep. Worth it after installing, and in the image of a container.
    """
    from beambox.cli.console import announce, show_log
    from beambox.infer.warm_up import steps_to_warm, warm_up
    from beambox.progress import progress_bar

    show_log(logging.ERROR)  # the weights are used to compile alone, so what they cannot do is no news
    announce("setup")
    steps = steps_to_warm(not no_training)
    spent = 0.0
    with progress_bar("compiling") as move:
        move(0, len(steps))
        for number, (what, seconds) in enumerate(warm_up(steps, device), start=1):
            move(number, len(steps))
            spent += seconds
            print(f"{what:<28} {seconds:6.1f} s", flush=True)
    print(f"ready: {len(steps)} steps, {spent:.0f} s; a second run takes less")
