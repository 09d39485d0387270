"""`beambox submit`: check result files for KITTI's test server and pack them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli.options import expect_there

__all__ = ["command"]


def command(
    results: Annotated[Path, typer.Argument(help="Folder of result files, one for each of the 7518 test frames.")],
    out: Annotated[Path, typer.Option(help="Archive to write.")] = Path("submission.zip"),
) -> None:
    """Check result files for KITTI's test server and pack them into the archive it takes.

    Example: beambox detect testing/velodyne --model M --format kitti --out results && beambox submit results
    """
    expect_there([results])

    from beambox.data.submission import write_submission

    write_submission(results, out)
    typer.echo(f"checked and packed: {out}")
