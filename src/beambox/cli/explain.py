"""`beambox explain`: what a detector's attention weighs, as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli import options
from beambox.cli.console import show_log

__all__ = ["command"]


def command(  # each is an option of the command line
    model: options.ModelArgument,
    inputs: options.InputsArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")] = Path("explained"),
    score_threshold: options.ScoreThresholdOption = 0.3,
    range_: options.RangeOption = "",
    view: options.ViewOption = "auto",
    sensor_height: options.HeightOption = None,
    fields: options.FieldsOption = "",
    intensity_scale: options.IntensityOption = None,
    device: options.DeviceOption = "auto",
) -> None:
    """Draw what HCNet, KASSD or DenNet weighs in sweeps.

    Examples:
      beambox explain dennet-kitti scan.bin --out explained

    HCNet: the weights of height slices and channels. KASSD: the weights of places and the scores of keypoints. DenNet:
    the densities of voxels, and what the surest boxes attend to.
    """
    from beambox.checks import expect_library

    expect_library("matplotlib", "plots", "drawing what a detector weighs")
    options.expect_there(inputs, model)

    from beambox.explain.pictures import explain
    from beambox.infer.inputs import find_sweeps
    from beambox.infer.predictor import load
    from beambox.visualize.canvas import save_picture

    show_log()
    sweeps = find_sweeps(inputs)
    detector = load(
        model,
        device=device,
        precision="float32",
        range=options.parse_range(range_),
        view=view,  # pyright: ignore[reportArgumentType]  # load checks it
        sensor_height=sensor_height,
        fields=fields or None,
        intensity_scale=intensity_scale,
    )
    for sweep in sweeps:
        for one in explain(detector, detector.read(sweep), score_threshold):
            path = out / f"{sweep.name}_{one.name}.png"
            save_picture(one.picture, path)
            print(f"{one.caption} -> {path}")
