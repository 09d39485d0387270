"""Options that several commands share, with one wording."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli.console import log

__all__ = [
    "AxesOption",
    "ClassesOption",
    "DefaultModelOption",
    "DeviceOption",
    "FieldsOption",
    "HeightOption",
    "InputsArgument",
    "IntensityOption",
    "IouOption",
    "ModelArgument",
    "ModelOption",
    "PrecisionOption",
    "RangeOption",
    "ScoreThresholdOption",
    "SlopeOption",
    "ViewOption",
    "expect_there",
    "model_or_default",
    "parse_classes",
    "parse_range",
    "parse_slope",
]

InputsArgument = Annotated[
    list[str], typer.Argument(metavar="INPUT", help="Sweeps: files, folders, patterns, recordings.")
]
ModelArgument = Annotated[
    str, typer.Argument(metavar="MODEL", help="Shipped name, .safetensors file, or folder of a run.")
]
ModelOption = Annotated[
    str, typer.Option("--model", "-m", metavar="M", help="Shipped name, .safetensors file, or folder of a run.")
]
DefaultModelOption = Annotated[
    str,
    typer.Option(
        "--model",
        "-m",
        metavar="M",
        help="Shipped name, .safetensors file, or folder of a run; pointpillars-sim if none.",
    ),
]
DeviceOption = Annotated[str, typer.Option(help="cpu, cuda, cuda:0; auto takes the GPU where there is one.")]
PrecisionOption = Annotated[str, typer.Option(help="auto, float32, bfloat16 or float16.")]
RangeOption = Annotated[
    str,
    typer.Option(
        "--range",
        metavar="R",
        help="Look elsewhere than in training: 50 for 50 m all around, or x0,y0,x1,y1 in metres.",
    ),
]
ViewOption = Annotated[
    str, typer.Option(help="camera keeps what the camera sees, full keeps all points; auto: camera where a calib is.")
]
HeightOption = Annotated[
    float | None,
    typer.Option(
        "--sensor-height", metavar="H", help="Metres of your sensor above the ground; 0 if z = 0 is the ground."
    ),
]
AxesOption = Annotated[str, typer.Option(metavar="A", help='Where your x and y lead, such as "x: right, y: forward".')]
SlopeOption = Annotated[
    str,
    typer.Option(
        "--ground-slope",
        metavar="F,L",
        help="Rise of the ground forward and left, metres per metre: 0,-0.03.",
    ),
]
IntensityOption = Annotated[
    float | None,
    typer.Option("--intensity-scale", metavar="F", help="Factor that brings intensity to 0..1, e.g. 0.01."),
]
FieldsOption = Annotated[
    str,
    typer.Option(metavar="F", help="Columns of .bin and .npy files, such as x,y,z,intensity,ring; _ leaves one out."),
]
ScoreThresholdOption = Annotated[
    float, typer.Option("--score-threshold", metavar="S", help="Leave out detections below this score.")
]
ClassesOption = Annotated[
    str, typer.Option("--classes", metavar="NAMES", help="Classes to score, as Car,Cyclist; by default the detector's.")
]
IouOption = Annotated[
    list[str] | None,
    typer.Option(
        "--iou",
        metavar="NAME=IOU",
        help="Overlaps other than the benchmark's: Car=0.5,Cyclist=0.25; or several of a class.",
    ),
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]


def expect_there(inputs: Iterable[str | Path | None], model: str = "") -> None:
    """Check that inputs and weights are there, before torch is imported, which takes seconds.

    Args:
        inputs: files, folders, patterns; None for what was not given.
        model: shipped name, weight file or folder of a run; empty where none was given.

    Raises:
        BeamboxError: naming the first that is not there.
    """
    from beambox.data.existence import expect_inputs
    from beambox.zoo import find_weights

    expect_inputs(given for given in inputs if given is not None)
    if model:
        find_weights(model)


def parse_classes(text: str) -> list[str]:
    """Read the value of --classes, each name once; an empty text names none."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def parse_range(text: str, option: str = "--range") -> float | list[float] | None:
    """Read the value of --range, or of another option that takes a region.

    Raises:
        BeamboxError: if it is neither one number nor four.
    """
    if not text:
        return None
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 4):
        raise BeamboxError(f'{option} takes one number, or four as x0,y0,x1,y1 in metres, got "{text}"')
    return numbers[0] if len(numbers) == 1 else numbers


def parse_slope(text: str) -> tuple[float, float]:
    """Read the value of --ground-slope.

    Raises:
        BeamboxError: if it is not two small numbers.
    """
    try:
        numbers = [float(word) for word in text.split(",")] if text else [0.0, 0.0]
    except ValueError:
        numbers = []
    if len(numbers) != 2 or max(map(abs, numbers)) > 0.3:
        raise BeamboxError(f'--ground-slope takes two numbers from -0.3 to 0.3, forward and left, got "{text}"')
    return numbers[0], numbers[1]


def model_or_default(model: str) -> str:
    """Return the model that was named, or the default after a line that says so."""
    if model:
        return model
    from beambox.zoo import DEFAULT

    log(f"no --model given: {DEFAULT}, which is free for any use; `beambox models` lists the others")
    return DEFAULT
