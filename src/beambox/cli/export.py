"""`beambox export`: write a detector as an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.checks import how_to_install
from beambox.cli import options
from beambox.cli.console import announce, show_log

__all__ = ["command"]


def command(
    model: options.ModelArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The .onnx file to write.")],
    opset: Annotated[int, typer.Option(metavar="N", help="Version of ONNX's operators, 18 to 23.")] = 18,
    sweep: Annotated[
        str, typer.Option("--verify", metavar="SCAN", help="Compare with PyTorch on this sweep too before writing.")
    ] = "",
    range_: options.RangeOption = "",
) -> None:
    """Write PointPillars, HCNet, SECOND or KASSD as one ONNX file, weights and settings inside.

    The file takes points gathered into voxels and gives boxes and scores of all anchors; docs/export.md says how both
    ends are done. It is written only if onnxruntime computes from it what PyTorch computes.

    Examples:
      beambox export pointpillars-kitti --out pointpillars.onnx
      beambox export run --out run.onnx --verify scan.bin --range 50
    """
    options.expect_there([sweep or None], model)

    from beambox.export.onnx_check import TOLERANCE
    from beambox.infer.cards import read_card
    from beambox.verbs import export
    from beambox.zoo import find_weights

    show_log()
    announce("export", detail=model)
    classes = read_card(find_weights(model)).classes
    written = export(model, out, range=options.parse_range(range_), opset=opset, verify=sweep or None)
    print(f"{out}: {model} ({', '.join(classes)}), {written.size / 1e6:.1f} MB, opset {opset}")
    print("  in   " + ", ".join(f"{name} {shape}" for name, shape in written.inputs.items()))
    print("  out  " + ", ".join(f"{name} {shape}" for name, shape in written.outputs.items()))
    for found in written.checks:
        turned = f"; half turns left to rounding: {found.half_turns}" if found.half_turns else ""
        print(
            f"  {found.sweep}, {found.points:,} points in {found.voxels:,} voxels: onnxruntime and PyTorch differ by "
            f"{found.scores:.1e} in scores, {found.boxes:.1e} in boxes (allowed {TOLERANCE:.0e}){turned}"
        )
    if not written.checks:
        print(f"  not compared with PyTorch: onnxruntime is not installed ({how_to_install('export')})")
