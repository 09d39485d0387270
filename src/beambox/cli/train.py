"""`beambox train`: train a detector by a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["command"]


def command(
    recipe: Annotated[Path, typer.Argument(help="YAML file of the run; the shipped ones lie in recipes/.")],
    data: Annotated[
        Path | None, typer.Option(help="What {data} of the recipe stands for: a folder, or a YAML file.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; runs/NAME where not given.")] = None,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a value: optim.lr=0.001; may be repeated.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the folder's last checkpoint.")] = False,
) -> None:
    """Train a detector.

    On many GPUs or machines: torchrun --nproc-per-node 8 -m beambox.cli.main train RECIPE --data DIR
    """
    from beambox.train.config import read_recipe

    parsed = read_recipe(recipe, change or [])
    if data is not None and not data.exists():
        from beambox.checks import MissingFileError

        kind = "file" if data.suffix in (".yaml", ".yml") else "folder"
        raise MissingFileError(f"--data: there is no {kind} {data}")

    from beambox.train.loop import train

    outcome = train(parsed, data, out or Path("runs") / parsed.name, resume)
    if not outcome.finished:
        raise typer.Exit(130)
