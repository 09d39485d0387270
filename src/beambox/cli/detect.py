"""`beambox detect`: boxes for every sweep that is named."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli import options
from beambox.cli.console import announce, log, progress, show_log
from beambox.cli.detector_options import DetectorOptions, takes_detector_options

if TYPE_CHECKING:
    from beambox.infer.inputs import Sweep
    from beambox.infer.jobs import Job, Tally
    from beambox.infer.predictor import Detector
    from beambox.structures import Detections, Frame

__all__ = ["command"]

UNSEEN = 0.2
"""Share of the points from which it is said that the network does not look at them."""
REACH = 75.0
"""Points farther than this to a side are no loss, metres."""


@takes_detector_options
def command(  # each is an option of the command line
    inputs: options.InputsArgument,
    model: options.DefaultModelOption = "",
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results.")] = Path(
        "detections"
    ),
    formats: Annotated[
        str, typer.Option("--format", "-f", metavar="F", help="json, csv, kitti, jsonl, parquet.")
    ] = "json",
    score_threshold: options.ScoreThresholdOption = 0.0,
    skip_existing: Annotated[bool, typer.Option("--skip-existing", help="Leave out sweeps that are done.")] = False,
    shard: Annotated[str, typer.Option(metavar="I/N", help="Do the I-th of N parts, as on machine I of N.")] = "1/1",
    workers: Annotated[int, typer.Option(min=1, max=1024, metavar="W", help="Processes, of one thread each.")] = 1,
    ray: Annotated[
        int, typer.Option(min=0, max=100_000, metavar="N", help="Do N parts as tasks of a Ray cluster.")
    ] = 0,
    *,
    how: DetectorOptions,
) -> None:
    """Find objects in sweeps; writes one result file per sweep.

    Examples:
      beambox detect scan.bin
      beambox detect kitti/training/velodyne --model run/best.safetensors --format kitti --out results
      beambox detect sweeps --format parquet --shard 3/10 --workers 8 --skip-existing --out found
      beambox detect "drive/*.pcd" -m pointpillars-sim --range 50 --sensor-height 1.9 --axes "x: right, y: forward"

    Boxes are x y z l w h yaw in the sweep's own frame: centre, metres, radians counter-clockwise from +x. KITTI's
    format needs the sweep's calibration, found as ../calib/ID.txt beside velodyne/ID.bin. Nothing found at all?
    `beambox doctor scan.bin --model M` says why.
    """
    options.expect_there(inputs, model)
    chosen = how.for_load()
    model = options.model_or_default(model)

    from beambox.infer.inputs import find_sweeps
    from beambox.infer.jobs import TABLES, Job, choose_kinds, parse_shard
    from beambox.infer.predictor import load

    show_log()
    part, kinds = parse_shard(shard), choose_kinds(formats)
    sweeps = find_sweeps(inputs)
    if "kitti" in kinds:
        need_calibration(sweeps)
    if ray:
        detect_on_ray(sweeps, Job(model, chosen, out, kinds, score_threshold, part), ray, skip_existing, workers)
        return
    if skip_existing or workers > 1 or part != (0, 1) or set(kinds) & set(TABLES):
        job = Job(model, chosen, out, kinds, score_threshold, part)
        detect_many(sweeps, job, workers, skip_existing)
        return
    detector = load(model, **chosen)
    announce("detect", detail=f"{model} on {detector.device} in {str(detector.dtype).removeprefix('torch.')}")
    detect_all(detector, sweeps, out, kinds, model, score_threshold)


def detect_many(sweeps: list[Sweep], job: Job, workers: int, skip_existing: bool) -> None:
    """Detect in a shard of very many sweeps, without a line for each."""
    from beambox.infer.jobs import run_job

    start = time.perf_counter()
    announce("detect", detail=f"{job.model}, shard {job.shard[0] + 1}/{job.shard[1]}, {workers} workers")
    tally = run_job(sweeps, job, workers, skip_existing=skip_existing)
    sum_up(tally, job, time.perf_counter() - start, workers)


def detect_on_ray(sweeps: list[Sweep], job: Job, parts: int, skip_existing: bool, workers: int) -> None:
    """Detect in all sweeps as tasks of Ray."""
    from beambox.infer.on_ray import need_ray, run_on_ray

    if job.shard != (0, 1) or workers > 1:
        raise BeamboxError("--ray makes parts and processes of its own: leave out --shard and --workers")
    need_ray()
    start = time.perf_counter()
    announce("detect", detail=f"{job.model}, {parts} parts on Ray")
    gpus = 1 if str(job.options["device"]).startswith("cuda") else 0
    tally = run_on_ray(sweeps, job, parts, skip_existing=skip_existing, gpus=gpus)
    sum_up(tally, job, time.perf_counter() - start, parts)


def sum_up(tally: Tally, job: Job, seconds: float, workers: int) -> None:
    """Tell what was done; status 2 where sweeps could not be read."""
    for fault in tally.faults:
        log(f"beambox: skipped: {fault}")
    rate = tally.sweeps / seconds / workers if seconds else 0.0
    log(
        f"{tally.sweeps} sweeps, {tally.boxes} detections, {seconds:.1f} s, {rate:.2f} sweeps/s per worker -> {job.out}"
    )
    if tally.failed:
        raise BeamboxError(f"{tally.failed} sweeps could not be read; the others are done")


def detect_all(
    detector: Detector, sweeps: list[Sweep], out: Path, kinds: list[str], model: str, score_threshold: float
) -> None:
    """Detect and write, sweep after sweep; one that cannot be read does not keep the others from being done."""
    from beambox.infer.results import write_results

    start, failed, found, hinted = time.perf_counter(), 0, 0, False
    for sweep in progress(sweeps, len(sweeps), "Detecting"):
        try:
            frame = detector.read(sweep)
        except BeamboxError as error:
            if len(sweeps) == 1:
                raise
            log(f"beambox: skipped: {error}")
            failed += 1
            continue
        if detector.sees_camera_only(frame) and not hinted:
            log("points outside the camera's view are left out (calib found; --view full keeps them)")
            hinted = True
        for note in frame.notes:
            log(f"{sweep.name}: {note}")
        if not hinted and (hint := unseen(detector, frame)):
            log(hint)
            hinted = True
        detections = detector.detect([frame])[0]
        detections = detections.above(score_threshold)
        written = write_results(out, frame, detections, kinds, model, sweep.name)
        found += len(detections)
        print(f"{sweep.name}: {counted(detections)} -> {', '.join(str(path) for path in written)}")
    seconds = time.perf_counter() - start
    log(f"{len(sweeps) - failed} sweeps, {found} detections, {seconds:.1f} s")
    if not found and not failed:
        log(f"nothing found; `beambox doctor {sweeps[0].path} --model {model}` says why")
    if failed:
        raise BeamboxError(f"{failed} of {len(sweeps)} sweeps could not be read; the others are done")


def unseen(detector: Detector, frame: Frame) -> str:
    """Say how much of a sweep lies where the network does not look, and what to do; empty where that is little."""
    prepared = detector.prepare(frame)
    low, high = detector.grid.minimum, detector.grid.maximum
    xy = prepared.points[:, :2]
    near = xy.abs().amax(dim=1) <= REACH
    outside = near & ((xy[:, 0] < low[0]) | (xy[:, 0] >= high[0]) | (xy[:, 1] < low[1]) | (xy[:, 1] >= high[1]))
    share = float(outside.sum()) / max(1, len(xy))
    if share < UNSEEN:
        return ""
    message = (
        f"{share:.0%} of the points lie where the network does not look (x {low[0]:g} to {high[0]:g}, y {low[1]:g} to "
        f"{high[1]:g} m): --range 50 looks all around"
    )
    return message + (", though these weights know only what lies there" if detector.config.absolute_xy else "")


def counted(detections: Detections) -> str:
    """Say what was found in a few words."""
    if not len(detections):
        return "no detections"
    counts = Counter(detections.names)
    words = [f"{counts[name]} {name}" for name in detections.classes if counts[name]]
    return f"{', '.join(words)}, best score {float(detections.scores.max()):.2f}"


def need_calibration(sweeps: list[Sweep]) -> None:
    """Refuse KITTI's format before the work starts where a sweep has no calibration.

    Raises:
        BeamboxError: naming the first such sweep.
    """
    from beambox.infer.inputs import calibration_beside

    lacking = [sweep for sweep in sweeps if calibration_beside(sweep.path) is None]
    if lacking:
        path = lacking[0].path
        raise BeamboxError(
            f"{path} has no calibration ({path.parent.parent / 'calib' / (path.stem + '.txt')}), and KITTI's format "
            "holds boxes in the camera's frame; write --format json or csv instead"
        )
