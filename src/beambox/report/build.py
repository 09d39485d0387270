"""From what a user names (weights or a folder of results, and data) to a measured evaluation and its page."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from beambox import __version__
from beambox.checks import BeamboxError, MissingFileError, expect_library
from beambox.data.custom import CustomSource
from beambox.data.custom_config import KITTI_GROUND
from beambox.data.once import OnceSource
from beambox.data.source import FrameSource
from beambox.infer.benchmark import device_name
from beambox.infer.cards import read_card
from beambox.infer.evaluate import detect_frames, scored_frames
from beambox.infer.predictor import Detector, View, load
from beambox.infer.results import find_result, read_result
from beambox.io import read_text, write_text
from beambox.metrics.kitti import KittiFrame
from beambox.progress import track
from beambox.report.failures import Picture, draw_failures, worst
from beambox.report.measure import Measured, PointCounts, TimedDetect, measure
from beambox.report.page import report_html
from beambox.report.tables import write_numbers
from beambox.structures import Detections, Frame
from beambox.zoo import find_weights

__all__ = [
    "Options",
    "about_data",
    "about_weights",
    "after_evaluation",
    "base_source",
    "check_page",
    "is_results",
    "measured",
    "write_page",
]

RECIPE_NAMES = ("recipe.yaml", "config.yaml")
"""What a run's folder calls the recipe it was trained by."""


@dataclass(frozen=True)
class Options:
    """How to detect and score."""

    data: Path
    split: str = "val"
    classes: tuple[str, ...] = ()
    """To score; the detector's where empty."""
    levels: bool = True
    """False: without KITTI's levels."""
    range: float | list[float] | None = None
    view: str = "auto"
    batch: int = 1
    device: str = "auto"
    precision: str = "auto"


def base_source(source: FrameSource) -> FrameSource:
    """Return the data set behind a part of it."""
    while hasattr(source, "source"):
        source = source.source  # pyright: ignore[reportAttributeAccessIssue]
    return source


def is_results(given: str) -> bool:
    """Tell a folder of results from weights: a folder without a weight file."""
    path = Path(given)
    return path.is_dir() and not any(path.glob("*.safetensors"))


def measured(given: str, source: FrameSource, options: Options) -> Measured:
    """Detect, or read results, and measure.

    Raises:
        BeamboxError: if there are no such weights or results, or the data have no labels.
    """
    counts = PointCounts()
    about = about_data(options.data, options.split)
    if is_results(given):
        found = _read_results(Path(given), source)
        frames = scored_frames(track(counts.watch(found), len(source), "reading"))
        known = dict.fromkeys(name for frame in frames for name in frame.detections.classes)
        classes, about = tuple(known), {"results": Path(given).name, **about}
    else:
        detect, classes, more = _detector(given, source, options)
        found = detect_frames(detect, source, batch=options.batch)
        frames = scored_frames(track(counts.watch(found), len(source), "detecting"))
        about = {**more, **about}
        if detect.summary():
            about["latency, ms per frame"] = detect.summary()
    classes = options.classes or classes
    if not classes:
        raise BeamboxError(f"{given} holds no detection, so the classes to score are not known; give --classes")
    by_once = isinstance(base_source(source), OnceSource)
    return measure(
        Path(given).stem,
        frames,
        classes,
        by_once=by_once,
        levels=options.levels,
        points=counts.counts,
        about=about,
    )


def _detector(given: str, source: FrameSource, options: Options) -> tuple[TimedDetect, tuple[str, ...], dict[str, Any]]:
    base, region, height = base_source(source), options.range, None
    if isinstance(base, CustomSource):
        region = region or base.config.range
        height = None if base.config.sensor_height is None else -KITTI_GROUND
    view: View = options.view  # pyright: ignore[reportAssignmentType]  # load checks it
    detector = load(
        given, device=options.device, precision=options.precision, view=view, range=region, sensor_height=height
    )
    about = {**about_weights(find_weights(given), detector), "frames in one pass": options.batch}
    return TimedDetect(detector.detect), tuple(detector.classes), about


def about_weights(path: Path, detector: Detector) -> dict[str, Any]:
    """Return what is known of a detector: its weights, where it runs, its card, the recipe beside it."""
    card = read_card(path)
    about: dict[str, Any] = {
        "detector": card.detector,
        "weights": f"{path.name}, sha256 {card.sha256}",
        "device": device_name(detector.device),
        "precision": str(detector.dtype).removeprefix("torch."),
        "card": dict(card.entries),
    }
    recipe = next((path.parent / name for name in RECIPE_NAMES if (path.parent / name).is_file()), None)
    if recipe is not None:
        about["recipe"] = {recipe.name: read_text(recipe)}
    return about


def about_data(data: Path | str, split: str) -> dict[str, Any]:
    """Return what was looked at, and with which versions."""
    return {
        "data": Path(data).name,
        "split": split,
        "beambox": __version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def _read_results(folder: Path, source: FrameSource) -> Iterator[tuple[Frame, Detections]]:
    names = list(source.ids)
    missing = [name for name in names if find_result(folder, name) is None]
    if missing:
        raise MissingFileError(
            f"{len(missing)} of {len(names)} frames have no results in {folder}, the first is {missing[0]} "
            "(.json, .csv or .txt); write an empty file where nothing was found"
        )
    for index, name in enumerate(names):
        path = find_result(folder, name)
        assert path is not None
        frame = source[index]
        yield frame, read_result(path, frame)


def after_evaluation(
    out: Path,
    found: Iterator[tuple[Frame, Detections]],
    source: FrameSource,
    classes: Sequence[str],
    by_once: bool,
    levels: bool,
) -> tuple[Iterator[tuple[Frame, Detections]], Callable[..., None]]:
    """Return detections to hand on, and what writes the report once they have all passed by.

    Args:
        out: the page.
        found: frames and their detections.
        source: of the frames.
        classes: to score.
        by_once: by ONCE's rules.
        levels: False: without KITTI's levels.

    Raises:
        BeamboxError: if the page's name does not end in .html.
    """
    check_page(out)
    counts = PointCounts()

    def write(frames: Sequence[KittiFrame], model: Any, detector: Detector, data: Any, split: str) -> None:
        named = isinstance(model, str | Path)
        about = about_weights(find_weights(model), detector) if named else {}
        about |= about_data(data if isinstance(data, str | Path) else "", split)
        name = Path(model).stem if named else "detector"
        one = measure(name, frames, classes, by_once=by_once, levels=levels, points=counts.counts, about=about)
        write_page(out, [one], source)

    return counts.watch(found), write


def check_page(out: Path) -> None:
    """Refuse a name that is no page's, and to begin without what draws it, before anything is measured."""
    expect_library("matplotlib", "plots", "a report")
    if out.suffix.lower() not in (".html", ".htm"):
        raise BeamboxError(f"a report is a page, so its name ends in .html; got {out}")


def write_page(
    out: Path,
    all_of: Sequence[Measured],
    source: FrameSource,
    most: int = 6,
    pages: bool = False,
    numbers: Sequence[Path] = (),
) -> None:
    """Write the report, the numbers, and where asked a 3-D page of each frame that it shows.

    Args:
        out: the page; frames go into the folder ``<stem>_frames`` beside it.
        all_of: one or two evaluations.
        source: of their frames.
        most: pictures of each kind of failure and class.
        pages: write 3-D pages.
        numbers: further files, by their endings.
    """
    first = all_of[0]
    failures = {name: worst(first.matches, name, most) for name in first.classes}
    some_of_all = [one for some in failures.values() for one in some]
    drawn = list(track(draw_failures(first, source, some_of_all), len(some_of_all), "drawing"))
    pictures: dict[str, list[Picture]] = {name: [] for name in first.classes}
    for picture in drawn:
        pictures[picture.failure.name].append(picture)
    links = _frame_pages(out, first, source, drawn) if pages else {}
    write_text(out, report_html(all_of, pictures, links=links))
    for path in numbers:
        write_numbers(path, all_of)


def _frame_pages(out: Path, one: Measured, source: FrameSource, drawn: Sequence[Picture]) -> Mapping[str, str]:
    from urllib.parse import quote

    from beambox.visualize.scene import Scene, scene_html

    folder = out.with_name(f"{out.stem}_frames")
    links = {}
    for number in sorted({picture.failure.frame for picture in drawn}):
        frame = source[number]
        name = f"{frame.id.replace('/', '_')}.html"
        scene = Scene(frame, one.frames[number].detections, one.frames[number].labels)
        write_text(folder / name, scene_html([scene], title=f"{frame.id}, {one.name}"))
        links[frame.id] = f"{quote(folder.name)}/{quote(name)}"
    return links
