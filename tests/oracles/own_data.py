"""A small data set of one's own: a flat road with cars on it, seen from a sensor at the origin."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

SENSOR_HEIGHT = 2.0


def scene(seed: int, cars: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Return ``(N, 4)`` points and ``(cars, 7)`` boxes, x forward, y left, ground at -SENSOR_HEIGHT."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack((rng.uniform(-45, 45, (6000, 2)), np.full(6000, -SENSOR_HEIGHT), rng.uniform(0, 1, 6000)))
    spots = rng.permutation([(x, y) for x in range(-40, 41, 10) for y in range(-30, 31, 10) if x or y])[:cars]
    boxes = np.array([[x, y, -SENSOR_HEIGHT + 0.75, 4.4, 1.8, 1.5, rng.uniform(-math.pi, math.pi)] for x, y in spots])
    parts = [ground]
    for box in boxes:
        local = rng.uniform(-0.5, 0.5, (150, 3))
        sides = np.arange(150)
        local[sides % 2 == 0, 0] = np.sign(local[sides % 2 == 0, 0]) * 0.49  # points lie on the sides
        local[sides % 2 == 1, 1] = np.sign(local[sides % 2 == 1, 1]) * 0.49
        local *= box[3:6]
        cos, sin = math.cos(box[6]), math.sin(box[6])
        x, y = local[:, 0] * cos - local[:, 1] * sin, local[:, 0] * sin + local[:, 1] * cos
        parts.append(np.column_stack((x + box[0], y + box[1], local[:, 2] + box[2], rng.uniform(0, 1, 150))))
    return np.concatenate(parts).astype(np.float32), boxes


def write_sweep(path: Path, points: np.ndarray) -> None:
    """Write float32 x, y, z, intensity."""
    path.parent.mkdir(parents=True, exist_ok=True)
    points.astype("<f4").tofile(path)


def write_pandaset(root: Path, frames: int = 3, config: str = "", change: object = None) -> Path:
    """Write sweeps, box files and the YAML file; ``change`` is a function of the boxes of each frame."""
    for seed in range(frames):
        points, boxes = scene(seed)
        write_sweep(root / "velodyne" / f"{seed:02d}.bin", points)
        labeled = change(boxes.copy()) if callable(change) else boxes
        lines = ["# label x y z l w h yaw"] + ["Car " + " ".join(f"{v:.4f}" for v in box) for box in labeled]
        (root / "boxes").mkdir(exist_ok=True)
        (root / "boxes" / f"{seed:02d}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    path = root / "data.yaml"
    text = "points: velodyne/{frame}.bin\nlabels: boxes/{frame}.txt\nformat: pandaset\nclasses: [Car]\n"
    path.write_text(text + (config or f"sensor_height: {SENSOR_HEIGHT}\n"), encoding="utf-8")
    return path
