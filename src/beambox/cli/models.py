"""`beambox models`: the shipped weights and where they come from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["command"]


def command(
    name: Annotated[
        str, typer.Argument(metavar="[MODEL]", help="Shipped name or weight file: print its whole card.")
    ] = "",
    json_file: Annotated[Path | None, typer.Option("--json", metavar="F", help="Write all cards here.")] = None,
) -> None:
    """List the shipped weights, or print the card of one.

    Examples:
      beambox models
      beambox models pointpillars-sim
      beambox models run/best.safetensors
    """
    import json

    from beambox.zoo import find_weights, shipped

    file = find_weights(name) if name else None

    from beambox.infer.cards import card_text, read_card
    from beambox.io import write_text

    if file is not None:
        print(card_text(read_card(file)))
        return
    cards = [read_card(path) for path in shipped().values()]
    if json_file is not None:
        write_text(json_file, json.dumps([card.to_json() for card in cards], indent=2) + "\n")
    if not cards:
        print("no weights are shipped with this installation; `beambox train` makes some")
    for card in cards:
        print(card.line())
