"""What one does with beambox, as functions; the commands of the command line parse, call one of these, and print."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beambox.checks import BeamboxError
from beambox.progress import progress_bar, track

if TYPE_CHECKING:
    import torch
    from PIL.Image import Image

    from beambox.data.source import FrameSource
    from beambox.export.onnx_file import Written
    from beambox.geometry import VoxelGrid
    from beambox.infer.evaluate import Evaluation
    from beambox.infer.predictor import Detector, View
    from beambox.infer.streaming import Input
    from beambox.simulate import Sensor
    from beambox.structures import Detections, Frame, Labels
    from beambox.train.config import Recipe
    from beambox.train.loop import TrainResult
    from beambox.train.recipes import ShippedRecipe
    from beambox.visualize.bev import ColorBy, Region

__all__ = ["draw", "evaluate", "export", "open_dataset", "recipes", "simulate", "train"]


def open_dataset(path: str | Path, split: str = "val", *, camera_view: bool = False) -> FrameSource:
    """Open a labelled data set; frames are read when they are asked for.

    Args:
        path: a folder in KITTI's or ONCE's layout, one with points/ and labels/, or the YAML file of one's own data.
        split: name of the list of frames, a file in ImageSets; "all" is every frame.
        camera_view: keep only the points that the camera sees, where the layout has a camera.

    Returns:
        A sequence of :class:`~beambox.Frame`: ``len(data)``, ``data[0]``, ``data.ids``.

    Raises:
        BeamboxError: if nothing is there, or it is no data set.
    """
    from beambox.data import open_dataset as data

    return data.open_dataset(path, split, fov=camera_view)


def evaluate(  # noqa: PLR0913  # each is an option of the command too
    model: str | Path | Detector,
    data: str | Path | FrameSource,
    *,
    split: str = "val",
    classes: Sequence[str] | None = None,
    iou: Sequence[Mapping[str, float]] = (),
    levels: bool = True,
    score_threshold: float = 0.0,
    results: str | Path | None = None,
    keep: str | Path | None = None,
    report: str | Path | None = None,
    batch_size: int = 1,
    device: str | torch.device | None = None,
    precision: str = "auto",
    range: float | Sequence[float] | VoxelGrid | None = None,
    view: View = "auto",
    progress: bool = True,
) -> Evaluation:
    """Detect in a labelled data set and score by KITTI's rules, or by ONCE's where the data have its layout.

    Args:
        model: a shipped name, a weight file, the folder of a training run, or a detector.
        data: what :func:`open_dataset` takes, or what it returns.
        split: name of the list of frames, where ``data`` is a path.
        classes: to score; the model's where None.
        iou: overlaps that count as found, by class, where they differ from the benchmark's; one mapping for each time
            that the detections are scored, after the first only the classes named.
        levels: False scores without KITTI's levels of difficulty: every object counts.
        score_threshold: leave out detections below it.
        results: folder for KITTI's result files, one per frame.
        keep: file that keeps the detections, frame by frame; what it holds is not detected again.
        report: page (.html) of curves, errors and the worst failures as pictures; ``beambox report`` can do more.
        batch_size: frames in one pass.
        device: "cpu", "cuda", ...; None takes the GPU where there is one.
        precision: "auto", "float32", "bfloat16" or "float16".
        range: region to look at, see :func:`beambox.load`.
        view: "camera", "full" or "auto", see :func:`beambox.load`.
        progress: show a bar where stderr is a terminal.

    Returns:
        The scores: ``print(scores)`` shows tables, ``scores.to_pandas()`` and ``scores.to_json()`` give the numbers.

    Raises:
        BeamboxError: if something cannot be read or scored; before the first frame where that can be known.
    """
    from beambox.data.custom import CustomSource
    from beambox.data.custom_config import KITTI_GROUND
    from beambox.data.once import OnceSource
    from beambox.infer.evaluate import check_classes, evaluate_frames, scored_frames
    from beambox.infer.predictor import Detector, load

    source = open_dataset(data, split) if isinstance(data, str | Path) else data
    by_once = isinstance(source, OnceSource)
    if results is not None and source[0].calibration is None:
        raise BeamboxError(
            "KITTI result files hold boxes in a camera's frame, and the data have no calibration; keep the detections "
            "by `keep` (--keep FILE) instead"
        )
    if isinstance(model, Detector):
        detector = model
    else:
        height = None
        if isinstance(source, CustomSource):
            range = range or source.config.range
            height = None if source.config.sensor_height is None else -KITTI_GROUND
        detector = load(model, device=device, precision=precision, view=view, range=range, sensor_height=height)
    wanted = list(classes) if classes else list(detector.classes)
    check_classes(wanted, iou, by_once)
    found = _found(detector, model, source, data, keep, batch_size, score_threshold)
    passing, write_report = _written(found, results), None
    if report is not None:
        from beambox.report.build import after_evaluation

        passing, write_report = after_evaluation(Path(report), passing, source, wanted, by_once, levels)
    frames = scored_frames(track(passing, len(source), "detecting", progress))
    if write_report is not None:
        write_report(frames, model, detector, data, split)
    precision = str(detector.dtype).removeprefix("torch.")
    return evaluate_frames(frames, wanted, iou or ({},), by_once=by_once, levels=levels, precision=precision)


def _found(
    detector: Detector,
    model: object,
    source: FrameSource,
    data: object,
    keep: str | Path | None,
    batch: int,
    least: float,
) -> Iterator[tuple[Frame, Detections]]:
    """Detect, or take what was kept."""
    from beambox.infer.evaluate import detect_frames
    from beambox.infer.kept import KeptDetections, digest
    from beambox.zoo import find_weights

    if keep is None:
        return detect_frames(detector.detect, source, batch=batch, score_threshold=least)
    if not isinstance(model, str | Path) or not isinstance(data, str | Path):
        raise BeamboxError("`keep` notes which weights and data the detections are of; give both by name or path")
    made_by: dict[str, Any] = {
        "model": Path(model).name,
        "weights": digest(find_weights(model)),
        "data": str(Path(data).resolve()),
        "precision": str(detector.dtype).removeprefix("torch."),
        "range": [list(detector.grid.minimum), list(detector.grid.maximum)],
        "view": detector.view,
        "raised": detector.alignment.z_offset,
        "score_threshold": least,
    }
    kept = KeptDetections(Path(keep), made_by, detector.classes)
    return kept.detect(detector.detect, source, batch=batch, score_threshold=least)


def _written(
    found: Iterator[tuple[Frame, Detections]], folder: str | Path | None
) -> Iterator[tuple[Frame, Detections]]:
    """Write each frame's KITTI result file as soon as it is there."""
    from beambox.infer.evaluate import write_result

    for frame, detections in found:
        if folder is not None:
            write_result(Path(folder), frame, detections)
        yield frame, detections


def train(
    recipe: str | Path | Recipe,
    data: str | Path | None = None,
    out: str | Path | None = None,
    *,
    overrides: Sequence[str] = (),
    resume: bool = False,
) -> TrainResult:
    """Train a detector by a recipe.

    Args:
        recipe: the name of a shipped recipe (:func:`recipes` lists them), a YAML file, or a recipe that was read.
        data: what ``{data}`` stands for in the recipe: a folder, or the YAML file of data of one's own.
        out: folder of the run; ``runs/NAME`` where None. It gets ``best.safetensors``, ``final.safetensors``,
            ``last.safetensors`` (to go on from), ``log.jsonl`` and ``tensorboard/``.
        overrides: changes of the recipe, such as ``"optim.lr=0.001"``; only with a file.
        resume: go on from the folder's last checkpoint.

    Returns:
        What came out: whether it finished, and where the weights are.

    Raises:
        BeamboxError: if the recipe, the data or the folder cannot be used.
    """
    from beambox.data.existence import expect_data
    from beambox.train.config import Recipe
    from beambox.train.stages import read_stages, train_stages

    if isinstance(recipe, Recipe) and overrides:
        raise BeamboxError("`overrides` change a recipe that is read from a file; change this one itself")
    stages = [recipe] if isinstance(recipe, Recipe) else read_stages(recipe, overrides)
    folder = None if data is None else Path(data)
    expect_data(folder)
    return train_stages(stages, folder, Path(out) if out is not None else Path("runs") / stages[-1].name, resume)


def simulate(
    out: str | Path,
    frames: int = 100,
    *,
    format: str = "kitti",
    sensor: str | Path | Sensor | None = None,
    view: str | None = None,
    layout: str = "random",
    layout_split: str | None = "train",
    seed: int = 0,
    workers: int = 1,
    val_share: float = 0.1,
    sequence_length: int = 10,
    progress: bool = True,
) -> Path:
    """Write a labelled data set of simulated LiDAR sweeps; one that is there is continued.

    Args:
        out: folder to write.
        frames: how many sweeps.
        format: layout of the files: "kitti", or "once" (whole turns, its axes and five classes).
        sensor: preset (hdl64, hdl32, pandar40, pandar64), YAML file or sensor; by the layout where None.
        view: "camera" (what the front camera sees) or "full" (the whole turn); by the layout where None.
        layout: "random", "kitti:PATH" (real layouts of objects) or "mixed:PATH" (half of each).
        layout_split: list of the layouts to draw from; None draws from all.
        seed: same seed, same data.
        workers: processes.
        val_share: fraction of the sweeps (ONCE: of the sequences) that are listed in ImageSets/val.txt.
        sequence_length: ONCE: sweeps in one sequence.
        progress: show a bar where stderr is a terminal.

    Returns:
        The folder.

    Raises:
        BeamboxError: bad arguments, or ``out`` holds another simulation or other data.
    """
    from beambox.simulate import write_dataset

    with progress_bar("simulating", progress) as report:
        return write_dataset(
            out, frames, sensor, view, layout, seed, workers, val_share, layout_split, report,
            files=format, sequence_length=sequence_length,
        )  # fmt: skip


def draw(
    sweep: Input,
    detections: Detections | None = None,
    labels: Labels | None = None,
    *,
    out: str | Path | None = None,
    region: Region | None = None,
    detection_range: Region | None = None,
    color_by: ColorBy = "height",
    title: str = "",
) -> Image:
    """Draw a sweep in BEV, with boxes, and the boxes into its camera image where there is one; needs no display.

    Args:
        sweep: a path, an array of points, or a frame.
        detections: drawn in the colors of their classes, with scores.
        labels: drawn in green; the frame's own where None.
        out: file to write too: .png, .jpg, or .html for a page in three dimensions.
        region: what to show, metres; chosen from the points where None.
        detection_range: the detector's region, drawn as a dashed line.
        color_by: what the colors of the points say: "height" or "intensity".
        title: first line of the legend; the frame's name where empty.

    Returns:
        The picture.

    Raises:
        BeamboxError: if the sweep cannot be read, or ``out`` ends otherwise.
    """
    from beambox.infer.inputs import read_sweep
    from beambox.io import write_text
    from beambox.structures import Frame
    from beambox.visualize.canvas import save_picture
    from beambox.visualize.picture import draw_sweep
    from beambox.visualize.viewer import viewer_html

    if isinstance(sweep, str | Path):
        frame = read_sweep(Path(sweep), labels=labels is None)
    else:
        frame = sweep if isinstance(sweep, Frame) else Frame.from_array(sweep)
    shown = frame.labels if labels is None else labels
    picture = draw_sweep(
        frame, detections, shown, region=region, detection_range=detection_range, color_by=color_by, title=title
    )  # fmt: skip
    if out is not None and Path(out).suffix.lower() == ".html":
        write_text(Path(out), viewer_html(frame, detections, shown, title=title))
    elif out is not None:
        save_picture(picture, Path(out))
    return picture


def export(
    model: str | Path,
    out: str | Path,
    *,
    range: float | Sequence[float] | VoxelGrid | None = None,
    opset: int = 18,
    verify: str | Path | None = None,
) -> Written:
    """Write a detector of one stage as an ONNX file, after onnxruntime has computed from it what PyTorch computes.

    Args:
        model: a shipped name, a weight file, or the folder of a training run.
        out: the .onnx file to write.
        range: region to look at, see :func:`beambox.load`.
        opset: version of ONNX's operators, 18 to 23.
        verify: a sweep to compare on too.

    Returns:
        What was written: its inputs, outputs and comparisons.

    Raises:
        BeamboxError: if the model cannot be exported, a package is missing, or the two differ; nothing is written then.
    """
    from beambox.detectors.weights import load_weights, read_weights
    from beambox.export.onnx_file import export_onnx, exportable
    from beambox.infer.predictor import Detector, region
    from beambox.zoo import find_weights

    path = find_weights(model)
    network = exportable(load_weights(path))
    grid = network.config.grid if range is None else region(network.config.grid, range)
    sweeps = {}
    if verify is not None:
        reader = Detector(network, device="cpu", precision="float32", grid=grid)
        sweeps = {str(verify): reader.prepare(reader.read(verify)).points}
    return export_onnx(network, out, grid=grid, opset=opset, card=read_weights(path).card, sweeps=sweeps)


def recipes() -> list[ShippedRecipe]:
    """List the shipped recipes: name, for whom, how long they take, whether they were ever run."""
    from beambox.train.recipes import list_recipes

    return list_recipes()
