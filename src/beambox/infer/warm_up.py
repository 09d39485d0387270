"""Make ahead of time what is otherwise made at first use: machine code for this machine's CPU or GPU."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import torch

from beambox.detectors.contract import module_of
from beambox.detectors.weights import load_weights
from beambox.infer.precision import choose_device
from beambox.infer.predictor import load
from beambox.metrics.kitti import KittiFrame, evaluate
from beambox.simulate import SimulatedSource
from beambox.structures import Batch, Detections, Frame
from beambox.zoo import DEFAULT, find_weights, shipped

__all__ = ["steps_to_warm", "warm_up"]

WINDOW = 256
"""Edge of the part of the range on which a step of training is tried, in cells."""
COARSE = 8
"""Its place is a multiple of so many cells, that of the coarsest map."""


def steps_to_warm(training: bool = True) -> list[tuple[str, str]]:
    """Return what :func:`warm_up` does, in order: (what, name of the weights), one set of weights per detector."""
    names = {name.split("-", maxsplit=1)[0]: name for name in shipped()}
    names[DEFAULT.split("-", maxsplit=1)[0]] = DEFAULT
    detect = [("detect", name) for name in names.values() if name in shipped()]
    return [("simulate", ""), *detect, *([("train", name) for _, name in detect] if training else []), ("score", "")]


def warm_up(
    steps: Sequence[tuple[str, str]], device: str = "auto", report: Callable[[str], None] = lambda _: None
) -> Iterator[tuple[str, float]]:
    """Use each part of beambox once, on a simulated sweep, so that nothing is left to compile.

    Args:
        steps: of :func:`steps_to_warm`.
        device: cpu, cuda, ...; "auto" takes the GPU where there is one.
        report: is given a line before each step.

    Yields:
        What was done, and how many seconds it took: a second time it takes as long as the work itself.
    """
    frame: Frame | None = None
    for what, name in steps:
        text = f"{what} {name}".strip()
        report(text)
        start = time.perf_counter()
        if frame is None or what == "simulate":
            frame = SimulatedSource(1, seed=1)[0]
        if what == "detect":
            load(name, device=device)(frame)
        elif what == "train":
            _train(name, frame, device)
        elif what == "score":
            _score(frame)
        yield text, time.perf_counter() - start


def _train(name: str, frame: Frame, device: str) -> None:
    """Compute losses and gradients once, on a small part of the range."""
    chosen = choose_device(device)
    model = load_weights(find_weights(name), chosen)
    module_of(model).train()
    grid = model.config.grid
    nx, ny, _ = grid.size
    side = min(WINDOW, nx, ny)
    window = grid.window((0, (ny - side) // 2 // COARSE * COARSE), (side, side))  # straight ahead
    assert frame.labels is not None, "simulated frames are labelled"
    batch = Batch.of([frame.camera_view(), frame.camera_view()]).to(chosen)
    labels = [frame.labels, frame.labels]
    losses = model.loss(model(batch, window, labels=labels), labels)
    torch.stack(list(losses.values())).sum().backward()


def _score(frame: Frame) -> None:
    """Score a frame's own labels as detections."""
    assert frame.labels is not None
    names = sorted(set(frame.labels.names) & {"Car", "Pedestrian", "Cyclist"}) or ["Car"]
    mine = frame.labels.of_classes(names)
    found = Detections(mine.boxes, torch.ones(len(mine)), mine.class_index(names), tuple(names))
    evaluate([KittiFrame(frame.labels, found, frame.calibration, frame.image_size or (1242, 375))], names)
