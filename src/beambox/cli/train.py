"""`beambox train`: train a detector by a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["command"]


def command(
    recipe: Annotated[
        str, typer.Argument(help="Name of a shipped recipe (`beambox recipes` lists them), or a YAML file.")
    ],
    data: Annotated[
        Path | None, typer.Option(help="What {data} of the recipe stands for: a folder, or a YAML file.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; runs/NAME where not given.")] = None,
    change: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change a value, in all stages: optim.lr=0.001; may be repeated."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the folder's last checkpoint.")] = False,
) -> None:
    """Train a detector.

    Examples:
      beambox train pointpillars-small --data data --out run
      beambox train mine.yaml --data data --set optim.lr=0.001

    On many GPUs or machines: torchrun --nproc-per-node 8 -m beambox train RECIPE --data DIR
    """
    from beambox.data.existence import expect_data
    from beambox.train.recipes import find_recipe

    find_recipe(recipe)
    expect_data(data)

    from beambox.verbs import train

    if not train(recipe, data, out, overrides=change or [], resume=resume).finished:
        raise typer.Exit(130)
