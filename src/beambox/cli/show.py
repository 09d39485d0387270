"""`beambox show`: a picture of a sweep."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import BeamboxError, MissingFileError, did_you_mean
from beambox.cli import options
from beambox.cli.console import progress, show_log
from beambox.cli.detector_options import DetectorOptions, takes_detector_options

if TYPE_CHECKING:
    from PIL.Image import Image

    from beambox.cli.show_inputs import Shown
    from beambox.geometry.axes import Axes
    from beambox.infer.predictor import Detector
    from beambox.structures import Detections, Frame, Labels
    from beambox.visualize.bev import Region
    from beambox.visualize.scene import Scene

__all__ = ["command"]


@takes_detector_options
def command(  # noqa: PLR0913  # each is an option of the command line
    inputs: Annotated[
        list[str],
        typer.Argument(metavar="INPUT", help="Sweeps: files, folders, patterns, recordings; or a data set (YAML)."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Picture (.png, .jpg), 3-D page (.html) or film (.gif, .webp, .mp4); a folder for several pictures.",
        ),
    ] = Path("show.png"),
    model: Annotated[str, typer.Option("--model", "-m", metavar="M", help="Detect with these weights.")] = "",
    results: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw these detections (json, csv, KITTI).")
    ] = None,
    labels: Annotated[str, typer.Option(metavar="DIR", help="Ground truth in KITTI's format; none draws none.")] = "",
    color: Annotated[str, typer.Option(help="Points by height or intensity.")] = "height",
    area: Annotated[str, typer.Option(metavar="A", help="What to show: 40 for 40 m all around, or x0,y0,x1,y1.")] = "",
    split: Annotated[str, typer.Option(help="Of a data set: the list of frames; all of them where not given.")] = "",
    names: Annotated[str, typer.Option(metavar="NAMES", help="Only the sweeps of these names, as 000001,000004.")] = "",
    frames: Annotated[int, typer.Option(min=0, help="Only the first so many sweeps; 0: all.")] = 0,
    rate: Annotated[float, typer.Option(help="Sweeps per second of films and of a page's time line.")] = 5.0,
    score_threshold: options.ScoreThresholdOption = 0.3,
    *,
    how: DetectorOptions,
) -> None:
    """Draw sweeps in BEV, with boxes, and the boxes into the camera image; no display is needed.

    Examples:
      beambox show scan.bin --model pointpillars-sim --out scan.png
      beambox show kitti/training/velodyne/000008.bin --out truth.png
      beambox show kitti/training/velodyne --results results --out pictures
      beambox show drive --model pointpillars-sim --out drive.html
      beambox show drive --model pointpillars-sim --out drive.webp --rate 10
      beambox show data.yaml --frames 20 --out pictures

    Labels and camera image are found beside a sweep in KITTI's layout (../label_2, ../image_2); a data set described by
    a YAML file brings its own labels. A page (.html) shows points and boxes in three dimensions in any browser, several
    sweeps with a time line, and needs no other file.
    """
    check_choices(color, model, results)
    check_rate(rate)
    options.expect_there(inputs, model)

    from beambox.cli import show_inputs
    from beambox.geometry.axes import Axes

    show_log()
    turned = Axes.parse(how.axes) if how.axes else Axes()
    shown = region_of_option(area)
    source = show_inputs.data_set_of(inputs, split)
    sweeps = show_inputs.sweeps_of(
        inputs, source, names, frames, fields=how.fields, intensity_scale=how.intensity_scale, labels=not labels
    )
    paths = picture_paths(sweeps, out)
    detector = show_inputs.detector_for(model, source, **how.for_load())

    def scenes() -> Iterator[Scene]:
        for sweep in progress(sweeps, len(sweeps), "Drawing"):
            yield scene_of(sweep.read(), detector, results, labels, turned)

    write_all(out, paths, sweeps, scenes(), detector, shown, color, score_threshold, rate)


FILMS = (".gif", ".webp", ".mp4")


def scene_of(frame: Frame, detector: Detector | None, results: Path | None, labels: str, axes: Axes) -> Scene:
    """Return what is known of a sweep, forward up."""
    from beambox.visualize.scene import Scene

    truth = truth_of(frame, labels)
    detections = found_in(frame, detector, results)
    frame = frame if detector is None else detector.crop(frame)
    return Scene(*forward_up(frame, detections, truth, axes))


def write_all(
    out: Path,
    paths: Sequence[Path],
    sweeps: Sequence[Shown],
    scenes: Iterator[Scene],
    detector: Detector | None,
    shown: Region | None,
    color: str,
    score_threshold: float,
    rate: float,
) -> None:
    """Write the page, the film or the pictures."""
    if out.suffix.lower() == ".html":
        write_scenes(out, scenes, score_threshold, rate)
    elif out.suffix.lower() in FILMS:
        write_film(out, film_pictures(scenes, detector, shown, color, score_threshold), rate)
    else:
        write_pictures(paths, sweeps, (picture_of(one, detector, shown, color, score_threshold) for one in scenes))


def check_choices(color: str, model: str, results: Path | None) -> None:
    """Refuse what cannot be drawn before anything is read."""
    if color not in ("height", "intensity"):
        raise BeamboxError(f'unknown colour "{color}"{did_you_mean(color, ["height", "intensity"])}')
    if model and results is not None:
        raise BeamboxError("give --model to detect now or --results to draw what was found before, not both")
    if results is not None and not results.is_dir():
        raise MissingFileError(f"{results} is not a folder of results")


def region_of_option(area: str) -> Region | None:
    """Read the value of --area."""
    from beambox.visualize.bev import Region

    numbers = options.parse_range(area, "--area")
    if numbers is None:
        return None
    return Region(*numbers) if isinstance(numbers, list) else Region(-numbers, -numbers, numbers, numbers)


def picture_paths(sweeps: Sequence[Shown], out: Path) -> list[Path]:
    """Return where each picture goes: the named file for one sweep, files in the named folder for several.

    Raises:
        BeamboxError: if the name's ending says no known form, or one picture is to hold several sweeps.
    """
    from beambox.visualize.video import can_write

    ending = out.suffix.lower()
    if ending in FILMS:
        can_write(out)
        return []
    if ending == ".html":
        return []
    if ending not in ("", ".png", ".jpg", ".jpeg"):
        raise BeamboxError(
            f"a picture is written as .png, .jpg or .html, a film as {', '.join(FILMS)}; got the name {out}"
        )
    if len(sweeps) == 1 and ending:
        return [out]
    if ending:
        raise BeamboxError(f"{len(sweeps)} sweeps make {len(sweeps)} pictures; give --out a folder, got {out}")
    return [out / f"{sweep.name}.png" for sweep in sweeps]


def write_scenes(out: Path, scenes: Iterable[Scene], score_threshold: float, rate: float) -> None:
    """Write all sweeps into one 3-D page."""
    from beambox.io import write_text
    from beambox.visualize.scene import scene_html

    some = list(scenes)
    write_text(out, scene_html(some, score_threshold=score_threshold, period=1 / rate))
    print(f"{some[0].frame.id if len(some) == 1 else f'{len(some)} sweeps'} -> {out}")


def write_film(out: Path, pictures: Iterable[Image], rate: float) -> None:
    """Write all sweeps into one film."""
    from beambox.visualize.video import write_video

    print(f"{write_video(out, pictures, rate)} sweeps -> {out}")


def write_pictures(paths: Sequence[Path], sweeps: Sequence[Shown], pictures: Iterable[Image]) -> None:
    """Write a picture per sweep."""
    from beambox.visualize.canvas import save_picture

    for path, sweep, picture in zip(paths, sweeps, pictures):
        save_picture(picture, path)
        print(f"{sweep.name} -> {path}")


def check_rate(rate: float) -> None:
    """Refuse a rate that no film has."""
    if not 0 < rate <= 100:
        raise BeamboxError(f"--rate must be more than 0 and at most 100 sweeps per second, got {rate:g}")


def film_pictures(
    scenes: Iterable[Scene], detector: Detector | None, shown: Region | None, color: str, score_threshold: float
) -> Iterator[Image]:
    """Draw the sweeps of a film: all show the same metres around the sensor, which the first sweep chooses."""
    from beambox.visualize.bev import region_of

    for scene in scenes:
        shown = shown or region_of(scene.frame, None if scene.labels is None else scene.labels.boxes)
        yield picture_of(scene, detector, shown, color, score_threshold)


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
    from beambox.infer.sensor_alignment import SensorAlignment

    turn = SensorAlignment(axes)
    if turn.nothing:
        return frame, detections, truth
    return (
        replace(turn.apply(frame), image_path=None),  # the camera knows the points' own axes only
        detections and replace(detections, boxes=turn.from_sensor(detections.boxes)),
        truth and truth.with_boxes(turn.from_sensor(truth.boxes)),
    )


def picture_of(
    scene: Scene, detector: Detector | None, shown: Region | None, color: str, score_threshold: float
) -> Image:
    """Draw, with the detector's region where there is one."""
    from beambox.visualize.bev import Region
    from beambox.visualize.picture import draw_sweep

    detection_range = None
    if detector is not None:
        (x0, y0, _), (x1, y1, _) = detector.grid.minimum, detector.grid.maximum
        detection_range = Region(x0, y0, x1, y1)
    detections = scene.detections
    if detections is not None:
        detections = detections.above(score_threshold)
    return draw_sweep(
        scene.frame,
        detections,
        scene.labels,
        region=shown,
        detection_range=detection_range,
        color_by="height" if color == "height" else "intensity",
    )
