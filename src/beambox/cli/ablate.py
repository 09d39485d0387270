"""`beambox ablate`: train and score the rows of one of the papers' tables; print ours beside theirs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.checks import BeamboxError

__all__ = ["command"]


def command(
    table: Annotated[
        str, typer.Argument(metavar="[TABLE]", help="Which table, as hcnet-table3; a wrong name lists them all.")
    ] = "",
    data: Annotated[Path | None, typer.Option(help="Folder that {data} stands for in the recipe.")] = None,
    seeds: Annotated[str, typer.Option(help="One run of each row for each of these, as 0,1,2.")] = "0",
    iterations: Annotated[int | None, typer.Option(min=1, help="Steps of each run; the recipe's by default.")] = None,
    recipe: Annotated[str, typer.Option(help="Recipe of every row, by name or file; the table's own by default.")] = "",
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Change a value of the recipe, in every row; may be repeated.")
    ] = None,
    table_file: Annotated[Path | None, typer.Option("--table", help="YAML file of a table of your own.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the runs; what is there already is not repeated.")] = Path(
        "runs/ablate"
    ),
    published: Annotated[bool, typer.Option("--published", help="Print the paper's numbers; train nothing.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the numbers here.")] = None,
) -> None:
    """Train and score the rows of one of the papers' tables; print ours beside theirs.

    All rows share one recipe and one list of seeds and differ in their switches alone. Interrupted, the same command
    goes on where it stopped.
    """
    from beambox.data.existence import expect_data
    from beambox.train.table_file import read_table
    from beambox.train.tables import table_of

    if bool(table) == (table_file is not None):
        raise BeamboxError("name one of the papers' tables, or give a file with --table; one of the two")
    chosen = read_table(table_file) if table_file is not None else table_of(table)
    if published:
        from beambox.train.ablation import report

        print(report(chosen, {}), end="")
        return
    wanted = parse_seeds(seeds)
    expect_data(data)

    from beambox.cli.console import log
    from beambox.train.ablation import Interrupted, report, run_table, to_json
    from beambox.train.config import read_recipe

    changes = list(change or [])
    if iterations is not None:
        changes += [f"optim.iterations={iterations}", "optim.epochs=null"]
    read = read_recipe(recipe or chosen.recipe, changes)
    try:
        measured = run_table(chosen, read, data, out, wanted, log)
    except Interrupted:
        raise typer.Exit(130) from None
    optim = read.optim
    length = f"{optim.iterations} steps" if optim.iterations else f"{optim.epochs:g} epochs"
    assert read.validation is not None
    overlaps = "".join(f", {name} at IoU {iou:g}" for name, iou in read.validation.iou.items())
    details = (
        f"recipe {read.name}, {length}, batch {optim.batch}, seeds {seeds}; "
        f"scored on `{read.validation.source.split}`{overlaps}"
    )
    print(report(chosen, measured, details), end="")
    if json_file is not None:
        from beambox.io import write_json

        write_json(json_file, to_json(chosen, measured, read, wanted))


def parse_seeds(text: str) -> list[int]:
    """Read the value of --seeds.

    Raises:
        BeamboxError: if it is not a list of whole numbers, at least 0, each once.
    """
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdigit() for word in words) or len({int(word) for word in words}) < len(words):
        raise BeamboxError(f'--seeds takes different whole numbers, as 0,1,2; got "{text}"')
    return [int(word) for word in words]
