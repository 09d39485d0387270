"""The whole chain on a few simulated sweeps: simulate, detect, score, draw."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from beambox.data.kitti import write_kitti_frame, write_split
from beambox.infer.predictor import Detector
from beambox.infer.results import write_results
from beambox.io import write_text
from beambox.metrics.kitti import KittiFrame, evaluate
from beambox.metrics.kitti_result import KittiResult
from beambox.simulate import SimulatedSource
from beambox.visualize.canvas import save_picture
from beambox.visualize.picture import draw_sweep

__all__ = ["Demo", "run_demo", "short_table"]


@dataclass(frozen=True)
class Demo:
    """What a demonstration left behind."""

    scores: KittiResult
    """Average precision of the sweeps."""
    pictures: tuple[Path, ...]
    """One picture per sweep."""
    objects: int
    """Number of objects in all sweeps."""
    detections: int
    """Number of detections in all sweeps."""


def run_demo(
    detector: Detector,
    out: Path,
    *,
    frames: int,
    seed: int,
    sensor: str = "hdl64",
    model: str = "",
    log: Callable[[str], None] = lambda _: None,
) -> Demo:
    """Simulate sweeps, detect in them, score and draw the detections.

    Writes ``out/data`` (KITTI's layout), ``out/results`` (KITTI and JSON), ``out/pictures`` and ``out/scores.json``.

    Args:
        detector: weights for the simulated sensor.
        out: folder; made where it is not there.
        frames: number of sweeps.
        seed: of the simulation.
        sensor: of the simulation.
        model: name of the weights, for the results.
        log: is given a line after each sweep.
    """
    source = SimulatedSource(frames, seed=seed, sensor=sensor)
    scored, pictures, objects, found = [], [], 0, 0
    for index in range(len(source)):
        frame = source[index]
        write_kitti_frame(out / "data", frame)
        detections = detector(frame)
        write_results(out / "results", frame, detections, ["kitti", "json"], model)
        sure = detections[detections.scores >= 0.3]
        picture = draw_sweep(frame, sure, frame.labels, title=f"Simulated sweep {frame.id}")
        pictures.append(out / "pictures" / f"{frame.id}.png")
        save_picture(picture, pictures[-1])
        assert frame.labels is not None, "simulated frames are labelled"
        scored.append(KittiFrame(frame.labels, detections, frame.calibration, frame.image_size or (1242, 375)))
        objects += len(frame.labels)
        found += len(sure)
        log(f"{frame.id}: {len(frame):,} points, {len(frame.labels)} objects, {len(sure)} found -> {pictures[-1]}")
    write_split(out / "data", "val", source.ids)
    scores = evaluate(scored, detector.classes)
    write_text(out / "scores.txt", scores.table())
    write_text(out / "scores.json", json.dumps(scores.to_json(), indent=2) + "\n")
    return Demo(scores, tuple(pictures), objects, found)


def short_table(scores: KittiResult) -> str:
    """Write one line per class: average precision over every recall, of the objects up to moderate difficulty."""
    lines = [f"{'AP, %':<14}{'objects':>8}{'overlap':>9}{'3-D':>8}{'above':>8}"]
    for one in scores.classes:
        three, above = one.box3d[1].all_points, one.bev[1].all_points
        lines.append(f"{one.name:<14}{one.objects[1]:>8}{one.iou:>9.2f}{three:>8.1f}{above:>8.1f}")
    return "\n".join(lines)
