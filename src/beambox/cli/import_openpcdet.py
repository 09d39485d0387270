"""`beambox import-openpcdet`: convert a checkpoint of OpenPCDet into a weight file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli.options import expect_there

__all__ = ["command"]


def command(
    checkpoint: Annotated[Path, typer.Argument(help="a .pth file that OpenPCDet wrote")],
    model: Annotated[str, typer.Option(help="pointpillars, second or voxel_rcnn")],
    out: Annotated[Path, typer.Option(help="the .safetensors file to write")],
) -> None:
    """Convert a checkpoint of OpenPCDet into a weight file.

    Reads tensors only, never code. The configuration is the toolbox's for KITTI (1 or 3 classes) or ONCE (5 classes),
    told from the head. A checkpoint that does not fit is refused with the names and shapes.
    """
    expect_there([checkpoint])

    from beambox.detectors.weights import save_weights
    from beambox.export.openpcdet import import_checkpoint

    detector = import_checkpoint(checkpoint, model)
    card = {"imported_from": f"OpenPCDet checkpoint {checkpoint.name}"}
    save_weights(out, detector, card)
    classes = ", ".join(detector.config.classes)
    print(f"{out}: {model} ({classes}) from {checkpoint}")
