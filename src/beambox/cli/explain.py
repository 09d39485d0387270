"""`beambox explain`: what a detector's attention weighs, as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beambox.cli import options
from beambox.cli.console import show_log
from beambox.cli.detector_options import DetectorOptions, takes_detector_options

__all__ = ["command"]


@takes_detector_options
def command(  # each is an option of the command line
    model: options.ModelArgument,
    inputs: options.InputsArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the pictures.")] = Path("explained"),
    score_threshold: options.ScoreThresholdOption = 0.3,
    *,
    how: DetectorOptions,
) -> None:
    """Draw what HCNet, KASSD or DenNet weighs in sweeps.

    Examples:
      beambox explain dennet-kitti scan.bin --out explained

    HCNet: the weights of height slices and channels. KASSD: the weights of places and the scores of keypoints. DenNet:
    the densities of voxels, and what the surest boxes attend to.
    """
    from beambox.checks import BeamboxError, expect_library

    expect_library("matplotlib", "plots", "drawing what a detector weighs")
    if how.precision not in ("auto", "float32"):
        raise BeamboxError(f"weights are explained in float32; leave out --precision, got {how.precision}")
    options.expect_there(inputs, model)

    from beambox.explain.pictures import explain
    from beambox.infer.inputs import find_sweeps
    from beambox.infer.predictor import load
    from beambox.visualize.canvas import save_picture

    show_log()
    sweeps = find_sweeps(inputs)
    detector = load(model, **{**how.for_load(), "precision": "float32"})
    for sweep in sweeps:
        for one in explain(detector, detector.read(sweep), score_threshold):
            path = out / f"{sweep.name}_{one.name}.png"
            save_picture(one.picture, path)
            print(f"{one.caption} -> {path}")
