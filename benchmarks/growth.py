"""How time and memory of detection grow with points, range, batch and boxes: a table, and a plot.

    python benchmarks/growth.py [--model pointpillars-kitti] [--threads 2] [--rounds 3] [--out growth.png] [--json FILE]

Points are those of simulated sweeps, all around the sensor, several on top of each other with a little noise where more
are wanted; 30,000 where something else is varied. Times are the shortest of the rounds, from points in memory to boxes.
Memory is what the process held at most during the first pass, beyond what it held before (not for boxes, for which a
pass has to run before). Each setting has a process of its own. Boxes are the anchors above the score threshold, which
the class bias is shifted for; only the best 4,096 enter the suppression.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from sides import Side, serve, timed
from timing import memory_added

SETTINGS: dict[str, tuple[float, ...]] = {
    "points": (10_000, 30_000, 100_000, 300_000, 1_000_000, 5_000_000),
    "range": (20, 40, 60, 80, 100),
    "batch": (1, 2, 4, 8),
    "boxes": (10, 100, 1_000, 10_000, 100_000),
}
UNITS = {
    "points": "points of a sweep",
    "range": "metres to each side",
    "batch": "sweeps in a pass",
    "boxes": "candidates before suppression",
}


def sweep(count: int, seed: int = 0) -> torch.Tensor:
    """Return so many points of simulated streets."""
    from beambox.simulate import simulate_frame

    generator = torch.Generator().manual_seed(seed)
    points = simulate_frame(seed, 0, view="full").points[:, :4]
    rows = torch.arange(count) % len(points) if count > len(points) else torch.randperm(len(points))[:count]
    noise = torch.randn(count, 3, generator=generator) * 0.05
    return torch.cat((points[rows, :3] + noise, points[rows, 3:]), dim=1)


def be(model: str, what: str, value: float, threads: int) -> None:
    """Be one setting."""
    from beambox import load
    from beambox.structures import Batch, Frame

    torch.set_num_threads(threads)
    detector = load(model, device="cpu", precision="float32", range=value if what == "range" else None, view="full")
    size = int(value) if what == "batch" else 1
    count = int(value) if what == "points" else 30_000
    frames = [Frame(sweep(count, seed)) for seed in range(size)]
    if what == "boxes":
        with torch.inference_mode():
            batch = Batch.of([detector.prepare(frame) for frame in frames])
            scores = detector.predict(batch).cls[0].amax(dim=1).sort(descending=True).values
        threshold = torch.logit(torch.tensor(detector.config.post.score_threshold))
        with torch.no_grad():
            detector.model.head.cls.bias += threshold - scores[int(value)]
    memory = memory_added(lambda: detector.detect(frames))
    detector.detect(frames)
    serve(f"{memory / 2**20:.0f}", {"run": lambda _: timed(lambda: detector.detect(frames))})


def measure(arguments: argparse.Namespace) -> dict[str, list[dict[str, float]]]:
    """Run every setting."""
    details: dict[str, list[dict[str, float]]] = {}
    for what, values in SETTINGS.items():
        for value in values:
            words = [__file__, "--side", what, str(value), "--model", arguments.model]
            side = Side(f"{what} {value}", [*words, "--threads", str(arguments.threads)], arguments.threads)
            runs = [[float(number) for number in side.ask("run").split()] for _ in range(arguments.rounds)]
            side.process.kill()
            wall, busy = (min(column) * 1e3 for column in zip(*runs))
            row = {"value": value, "ms": round(wall, 1), "cpu_ms": round(busy, 1), "memory_mib": float(side.details)}
            details.setdefault(what, []).append(row)
            print(f"{what:8} {value:>12,.0f}  {wall:9.1f} ms  {busy:9.1f} ms CPU  {side.details:>6} MiB", flush=True)
    return details


def draw(details: dict[str, list[dict[str, float]]], title: str, path: Path) -> None:
    """Plot time and memory against each."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(details), figsize=(3.4 * len(details), 3.0), layout="constrained")
    for axis, (what, rows) in zip(axes, details.items()):
        values = [row["value"] for row in rows]
        (time,) = axis.plot(values, [row["cpu_ms"] for row in rows], "o-", color="tab:blue", label="CPU time, ms")
        beside = axis.twinx()
        held = [row["memory_mib"] if what != "boxes" else float("nan") for row in rows]
        (memory,) = beside.plot(values, held, "s--", color="tab:orange", label="memory, MiB")
        axis.set_xlabel(UNITS[what])
        if what in ("points", "boxes"):
            axis.set_xscale("log")
        axis.set_ylim(bottom=0)
        beside.set_ylim(bottom=0)
        beside.set_visible(what != "boxes")
    axes[0].legend(handles=[time, memory], loc="upper left", fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--model", default="pointpillars-kitti", help="a detector of one stage with an anchor head")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("growth.png"), help="the plot")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--side", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        be(arguments.model, arguments.side[0], float(arguments.side[1]), arguments.threads)
        return
    details: dict[str, Any] = measure(arguments)
    draw(details, f"{arguments.model}, threads: {arguments.threads}, float32", arguments.out)
    if arguments.json:
        arguments.json.write_text(json.dumps(details, indent=1))


if __name__ == "__main__":
    main()
