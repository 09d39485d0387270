"""`beambox recipes`: the shipped recipes: for whom they are, how long they take, whether they were ever run."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["command"]


def command(
    name: Annotated[str, typer.Argument(metavar="[RECIPE]", help="Print this recipe's file.")] = "",
) -> None:
    """List the shipped recipes, or print one: what `beambox train NAME` takes.

    Examples:
      beambox recipes
      beambox recipes pointpillars-kitti
      beambox recipes pointpillars-small > mine.yaml
    """
    from beambox.train.recipes import AUDIENCES, find_recipe, list_recipes

    if name:
        print(find_recipe(name).read_text(encoding="utf-8"), end="")
        return
    for audience, purpose in AUDIENCES.items():
        print(f"{audience}: {purpose}")
        for one in list_recipes():
            if one.audience == audience:
                stages = f"; stages: {', '.join(one.stages)}" if one.stages else ""
                print(f"  {one.name}\n      {one.description}\n      takes {one.takes}; ran: {one.ran}{stages}")
        print()
