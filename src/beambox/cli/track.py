"""`beambox track`: identities and velocities for the objects of a drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli import options
from beambox.cli.console import announce, log, progress, show_log
from beambox.cli.detector_options import DetectorOptions, takes_detector_options

if TYPE_CHECKING:
    from beambox.geometry import Calibration
    from beambox.infer.inputs import Sweep
    from beambox.infer.predictor import Detector
    from beambox.track.poses import Poses
    from beambox.track.sequence import Step
    from beambox.track.tracks import Tracks

__all__ = ["command"]


@takes_detector_options
def command(  # noqa: PLR0913  # each is an option of the command line
    inputs: Annotated[list[str] | None, typer.Argument(metavar="[INPUT]...", help="Sweeps of one drive.")] = None,
    model: Annotated[str, typer.Option("--model", "-m", metavar="M", help="Detect with these weights.")] = "",
    results: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Or take these result files: any KITTI's.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help=".csv, .jsonl, or .txt (KITTI).")] = Path(
        "tracks.csv"
    ),
    calib: Annotated[Path | None, typer.Option(metavar="PATH", help="Calib file of the drive, or folder.")] = None,
    poses: Annotated[Path | None, typer.Option(metavar="FILE", help="Poses, one per line: KITTI, 4x4 or TUM.")] = None,
    poses_of: Annotated[str, typer.Option(help="Whose poses: lidar, or camera (KITTI odometry).")] = "lidar",
    rate: Annotated[float, typer.Option(metavar="HZ", help="Sweeps per second, where files tell no time.")] = 10.0,
    birth_score: Annotated[float, typer.Option(metavar="S", help="A detection from here on may start a track.")] = 0.3,
    confirm_score: Annotated[float, typer.Option(metavar="S", help="Report tracks from this mean score on.")] = 0.5,
    score_threshold: options.ScoreThresholdOption = 0.1,
    coast: Annotated[float, typer.Option(metavar="S", help="Seconds to report a track without detection.")] = 0.0,
    *,
    how: DetectorOptions,
) -> None:
    """Track objects through a drive: one identity each, velocities, births and deaths.

    Examples:
      beambox track drive/velodyne --model voxel_rcnn-kitti --out tracks.csv
      beambox track --results detections --calib calib.txt --out tracks.txt
      beambox track drive.mcap -m pointpillars-kitti --poses poses.txt --out tracks.jsonl

    With poses (from the LiDAR to a fixed frame, one per sweep) velocities are over ground; without them relative to the
    sensor. Score KITTI's format by `beambox score tracking`.
    """
    options.expect_there([*(inputs or []), results, calib, poses], model)

    from beambox.infer.inputs import find_sweeps
    from beambox.track import Tracker, TrackerOptions
    from beambox.track.files import check_ending
    from beambox.track.sequence import read_drive, stamps_of, track_drive

    show_log()
    check_ending(out)
    if bool(model) == (results is not None) or bool(model) != bool(inputs):
        raise BeamboxError("give sweeps and --model M, or --results DIR and no sweeps")
    birth = max(birth_score, score_threshold)
    chosen = TrackerOptions(
        score_threshold=score_threshold, birth_score=birth, confirm_score=confirm_score, coast=coast
    )
    tracker = Tracker(chosen, rate=rate)
    given = given_poses(poses, poses_of, calib)
    sweeps = find_sweeps(inputs or [])
    find = calibrations(calib, sweeps)
    need_calibration(out, find)
    if results is not None:
        steps = read_drive(results, find)
    else:
        from beambox.infer.predictor import load

        detector = load(model, **how.for_load())
        steps = detect_steps(detector, sweeps)
    total = len(steps) if isinstance(steps, list) else len(sweeps)
    times = stamps_of([sweep.name for sweep in sweeps]) if sweeps else None
    announce("track", detail=model or f"results of {results}")
    followed = track_drive(tracker, progress(steps, total, "Tracking"), poses=given, times=times)
    write_tracks(followed, out, model or str(results), find)


def write_tracks(
    followed: Iterator[tuple[Step, Tracks]], out: Path, model: str, find: Callable[[str], Calibration] | None
) -> None:
    """Write tracks as they come, and print what was tracked."""
    from beambox.track.files import track_file

    total, classes = 0, {}
    with track_file(out, model, find, (1242, 375)) as write:
        for step, tracks in followed:
            write(tracks, step.number)
            classes.update(zip(tracks.ids.tolist(), tracks.names))
            print(f"{step.name}: {len(tracks)} tracks")
            total += 1
    counts = ", ".join(f"{count} {name}" for name, count in Counter(classes.values()).items()) or "none"
    log(f"{total} sweeps, {len(classes)} tracks ({counts}) -> {out}")


def given_poses(path: Path | None, whose: str, calib: Path | None) -> Poses | None:
    """Read the poses that are asked for, as those of the LiDAR."""
    from beambox.data.kitti_text import read_calibration
    from beambox.track import read_poses

    if whose not in ("lidar", "camera"):
        raise BeamboxError(f'--poses-of takes lidar or camera, got "{whose}"')
    if path is None:
        return None
    if whose == "lidar":
        return read_poses(path)
    if calib is None or not calib.is_file():
        raise BeamboxError("--poses-of camera needs --calib FILE, to carry the poses to the LiDAR")
    return read_poses(path, read_calibration(calib))


def need_calibration(out: Path, find: Callable[[str], Calibration] | None) -> None:
    """Refuse KITTI's format before the work starts where there is no calibration."""
    if out.suffix.lower() == ".txt" and find is None:
        raise BeamboxError(
            f"{out}: KITTI's format holds boxes in the camera's frame, which needs a calibration: give --calib, or "
            "write .csv or .jsonl"
        )


def detect_steps(detector: Detector, sweeps: list[Sweep]) -> Iterator[Step]:
    """Detect sweep after sweep; one that cannot be read is one without detections."""
    from beambox.structures import Detections
    from beambox.track.sequence import Step, frame_numbers

    for number, sweep in zip(frame_numbers([sweep.name for sweep in sweeps]), sweeps):
        try:
            found = detector.detect([detector.read(sweep)])[0]
        except BeamboxError as error:
            if len(sweeps) == 1:
                raise
            log(f"beambox: no detections: {error}")
            found = Detections.empty(detector.classes, sweep.name)
        yield Step(sweep.name, number, found)


def calibrations(calib: Path | None, sweeps: list[Sweep]) -> Callable[[str], Calibration] | None:
    """Return what finds the calibration of a sweep by its name, or None where there is none.

    Args:
        calib: one file for all, a folder of NAME.txt, or None to look beside the sweeps.
        sweeps: where to look.
    """
    from functools import cache

    from beambox.data.kitti_text import read_calibration
    from beambox.infer.inputs import calibration_beside

    if calib is not None and not calib.is_dir():
        only = read_calibration(calib)
        return lambda name: only
    beside = {sweep.name: calibration_beside(sweep.path) for sweep in sweeps}
    if calib is None and (not beside or None in beside.values()):
        return None

    @cache
    def find(name: str) -> Calibration:
        return read_calibration(beside[name] or Path() if calib is None else calib / f"{name}.txt")

    return find
