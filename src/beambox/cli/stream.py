"""`beambox stream`: boxes for every sweep of a recording, written back as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beambox.checks import BeamboxError
from beambox.cli import options
from beambox.cli.console import announce, log, show_log
from beambox.cli.detector_options import DetectorOptions, takes_detector_options

if TYPE_CHECKING:
    from beambox.infer.predictor import Detector

__all__ = ["command"]


@takes_detector_options
def command(  # each is an option of the command line
    source: Annotated[
        Path, typer.Argument(metavar="INPUT", help="Recording (.mcap, .bag, .db3), or folder of sweeps.")
    ],
    model: options.ModelOption,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The .mcap file to write.")],
    topic: Annotated[str, typer.Option(metavar="T", help="Of the point clouds, where there are several.")] = "",
    track: Annotated[bool, typer.Option("--track/--no-track", help="Give objects identities and velocities.")] = True,
    realtime: Annotated[bool, typer.Option("--realtime", help="Play as recorded; drop old sweeps to keep up.")] = False,
    speed: Annotated[float, typer.Option(metavar="X", help="With --realtime: play X times as fast.")] = 1.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Sweeps per second of a folder.")] = 10.0,
    score_threshold: options.ScoreThresholdOption = 0.1,
    *,
    how: DetectorOptions,
) -> None:
    """Detect and track through a recording, read once; boxes keep its stamps and frame ids.

    Examples:
      beambox stream drive.mcap --model pointpillars-kitti --out boxes.mcap
      beambox stream drive.bag -m voxel_rcnn-kitti --topic /velodyne_points --range 50 --out boxes.mcap
      beambox stream drive.db3 -m pointpillars-kitti --realtime --out boxes.mcap

    Written for each sweep, below its topic: beambox/markers (MarkerArray), beambox/detections (Detection3DArray) and
    beambox/scene (Foxglove SceneUpdate).
    """
    options.expect_there([source], model)
    if not (rate > 0 and speed > 0):
        raise BeamboxError(f"--rate and --speed must be above 0, got {rate:g} and {speed:g}")
    if out.resolve() == source.resolve():
        raise BeamboxError(f"{out} is the recording that is read; give another name")

    from beambox.infer.predictor import load
    from beambox.stream.run import in_real_time, recording_writer, run_stream
    from beambox.stream.source import arrivals

    show_log()
    tracker = None
    if track:
        from beambox.track import Tracker, TrackerOptions

        tracker = Tracker(
            TrackerOptions(score_threshold=score_threshold, birth_score=max(0.3, score_threshold)), rate=rate
        )
    detector = load(model, **how.for_load())
    announce("stream", detail=f"{model} on {detector.device} in {str(detector.dtype).removeprefix('torch.')}")
    settings = {
        "model": model,
        "source": source.name,
        "topic": topic,
        "track": track,
        "score_threshold": score_threshold,
    }
    settings |= {"range": how.range_, "view": how.view, "sensor_height": how.sensor_height, "axes": how.axes}
    settings |= {"precision": how.precision}
    dropped: list[str] = []
    sweeps = arrivals(source, topic, rate=rate, fields=how.fields or None, intensity_scale=how.intensity_scale)
    if realtime:
        warm_up(detector)
        sweeps = in_real_time(sweeps, lambda sweep: dropped.append(sweep.name), speed=speed)
    with recording_writer(out, settings) as write:
        report = run_stream(
            sweeps,
            lambda frame: detector.detect([frame])[0],
            tracker,
            write,
            score_threshold=score_threshold,
            notice=lambda text: log(f"beambox: {text}"),
        )
        report.dropped = len(dropped)
        if not report.done:
            raise BeamboxError(f"{source}: no sweep could be read, so nothing was written")
    log(report.text())
    print(f"{report.done} sweeps, {report.objects} boxes -> {out}")


def warm_up(detector: Detector) -> None:
    """Detect once in random points: the first sweep would otherwise wait for what is compiled then."""
    import torch

    from beambox.structures import Frame

    low, high = torch.tensor(detector.grid.minimum), torch.tensor(detector.grid.maximum)
    points = torch.rand(20_000, 4, generator=torch.Generator().manual_seed(0))
    points[:, :3] = low + points[:, :3] * (high - low)
    detector.detect([Frame(points.float())])
