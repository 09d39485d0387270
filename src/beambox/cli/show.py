"""`beambox show`: a picture of a sweep."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.cli import options
from beambox.cli.console import progress, show_log

if TYPE_CHECKING:
    from PIL.Image import Image

    from beambox.geometry.axes import Axes
    from beambox.infer.inputs import Sweep
    from beambox.infer.predictor import Detector
    from beambox.structures import Detections, Frame, Labels
    from beambox.visualise.bev import Region

__all__ = ["command"]


def command(  # noqa: PLR0913, PLR0917  # each is an option of the command line
    inputs: options.InputsArgument,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Picture (.png, .jpg) or page (.html); a folder for several.")
    ] = Path("show.png"),
    model: Annotated[str, typer.Option("--model", "-m", metavar="M", help="Detect with these weights.")] = "",
    results: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw these detections (json, csv, KITTI).")
    ] = None,
    labels: Annotated[str, typer.Option(metavar="DIR", help="Ground truth in KITTI's format; none draws none.")] = "",
    colour: Annotated[str, typer.Option(help="Points by height or intensity.")] = "height",
    area: Annotated[str, typer.Option(metavar="A", help="What to show: 40 for 40 m all around, or x0,y0,x1,y1.")] = "",
    min_score: options.MinScoreOption = 0.3,
    range_: options.RangeOption = "",
    view: options.ViewOption = "auto",
    sensor_height: options.HeightOption = None,
    axes: options.AxesOption = "",
    ground_slope: options.SlopeOption = "",
    intensity_scale: options.IntensityOption = None,
    fields: options.FieldsOption = "",
    device: options.DeviceOption = "auto",
    precision: options.PrecisionOption = "auto",
) -> None:
    """Draw sweeps from above, with boxes, and the boxes into the camera image; no display is needed.

    Examples:
      beambox show scan.bin --model pointpillars-sim --out scan.png
      beambox show kitti/training/velodyne/000008.bin --out truth.png
      beambox show kitti/training/velodyne --results results --out pictures
      beambox show scan.bin --model pointpillars-sim --out scan.html

    Labels and camera image are found beside a sweep in KITTI's layout (../label_2, ../image_2). A page (.html) shows
    points and boxes in three dimensions in any browser, and needs no other file.
    """
    from beambox.data.existence import expect_inputs

    check_choices(colour, model, results)
    expect_inputs(inputs)

    from beambox.geometry.axes import Axes
    from beambox.infer.inputs import find_sweeps, read_sweep
    from beambox.infer.predictor import load
    from beambox.io import write_text
    from beambox.visualise.canvas import save_picture
    from beambox.visualise.viewer import viewer_html

    show_log()
    turned = Axes.parse(axes) if axes else Axes()
    shown = region_of_option(area)
    sweeps = find_sweeps(inputs)
    detector = None
    if model:
        detector = load(
            model,
            device=device,
            precision=precision,
            range=options.parse_range(range_),
            view=view,  # pyright: ignore[reportArgumentType]  # load checks it
            sensor_height=sensor_height,
            axes=turned,
            ground_slope=options.parse_slope(ground_slope),
            intensity_scale=intensity_scale,
            fields=fields or None,
        )
    paths = picture_paths(sweeps, out)
    for sweep, path in progress(zip(sweeps, paths), len(sweeps), "Drawing"):
        frame = read_sweep(sweep, fields=fields or None, intensity_scale=intensity_scale, labels=not labels)
        truth = truth_of(frame, labels)
        detections = found_in(frame, detector, results)
        if detections is not None:
            detections = detections.above(min_score)
        frame = frame if detector is None else detector.crop(frame)
        frame, detections, truth = forward_up(frame, detections, truth, turned)
        if path.suffix == ".html":
            write_text(path, viewer_html(frame, detections, truth))
        else:
            save_picture(picture_of(frame, detections, truth, detector, shown, colour), path)
        print(f"{sweep.name} -> {path}")


def check_choices(colour: str, model: str, results: Path | None) -> None:
    """Refuse what cannot be drawn before anything is read."""
    if colour not in ("height", "intensity"):
        raise BeamboxError(f'unknown colour "{colour}"{did_you_mean(colour, ["height", "intensity"])}')
    if model and results is not None:
        raise BeamboxError("give --model to detect now or --results to draw what was found before, not both")
    if results is not None and not results.is_dir():
        raise MissingFileError(f"{results} is not a folder of results")


def region_of_option(area: str) -> Region | None:
    """Read the value of --area."""
    from beambox.visualise.bev import Region

    numbers = options.parse_range(area, "--area")
    if numbers is None:
        return None
    return Region(*numbers) if isinstance(numbers, list) else Region(-numbers, -numbers, numbers, numbers)


def picture_paths(sweeps: list[Sweep], out: Path) -> list[Path]:
    """Return where each picture goes: the named file for one sweep, files in the named folder for several."""
    if out.suffix and out.suffix.lower() not in (".png", ".jpg", ".jpeg", ".html"):
        raise BeamboxError(f"a picture is written as .png, .jpg or .html, got the name {out}")
    if len(sweeps) == 1 and out.suffix:
        return [out]
    if out.suffix:
        raise BeamboxError(f"{len(sweeps)} sweeps make {len(sweeps)} pictures; give --out a folder, got {out}")
    return [out / f"{sweep.name}.png" for sweep in sweeps]


def truth_of(frame: Frame, labels: str) -> Labels | None:
    """Return the ground truth to draw: what lies beside the sweep, or in the named folder.

    Raises:
        BeamboxError: if a folder is named that has no labels of the sweep, or they cannot be placed.
    """
    from beambox.data.kitti import read_labels

    if labels in ("", "none"):
        return frame.labels if not labels else None
    path = Path(labels) / f"{Path(frame.id).name}.txt"
    if frame.calibration is None:
        raise BeamboxError(f"{path} holds boxes in the camera's frame; they need the calibration of {frame.id}")
    return read_labels(path, frame.calibration)


def found_in(frame: Frame, detector: Detector | None, results: Path | None) -> Detections | None:
    """Return the detections to draw: found now, or read from a folder."""
    from beambox.infer.results import find_result, read_result

    if detector is not None:
        return detector.detect([frame])[0]
    if results is None:
        return None
    path = find_result(results, frame.id)
    if path is None:
        raise MissingFileError(f"{results} holds no results of {frame.id} (.json, .csv or .txt)")
    return read_result(path, frame)


def forward_up(
    frame: Frame, detections: Detections | None, truth: Labels | None, axes: Axes
) -> tuple[Frame, Detections | None, Labels | None]:
    """Turn points of other axes to x forward, y left, z up, and the boxes with them."""
    from beambox.infer.corrections import Corrections

    turn = Corrections(axes)
    if turn.nothing:
        return frame, detections, truth
    return (
        replace(turn.apply(frame), image_path=None),  # the camera knows the points' own axes only
        detections and replace(detections, boxes=turn.carry_forward(detections.boxes)),
        truth and truth.with_boxes(turn.carry_forward(truth.boxes)),
    )


def picture_of(
    frame: Frame,
    detections: Detections | None,
    truth: Labels | None,
    detector: Detector | None,
    shown: Region | None,
    colour: str,
) -> Image:
    """Draw, with the detector's region where there is one."""
    from beambox.visualise.bev import Region
    from beambox.visualise.picture import draw_sweep

    looked_at = None
    if detector is not None:
        (x0, y0, _), (x1, y1, _) = detector.grid.minimum, detector.grid.maximum
        looked_at = Region(x0, y0, x1, y1)
    return draw_sweep(
        frame,
        detections,
        truth,
        region=shown,
        looked_at=looked_at,
        colour_by="height" if colour == "height" else "intensity",
    )
