"""Make the pictures of docs/gallery.md: ``python docs/make_gallery.py [--kitti DIR] [OUT]``.

Simulated scenes, whose pictures are kept in docs/pictures, and, where ``--kitti`` names scans at hand, real ones, whose
pictures are not: KITTI's licence (CC BY-NC-SA 3.0) is not that of this repository.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from PIL import Image

import beambox
from beambox.data.kitti import KittiSource
from beambox.simulate import SimulatedSource
from beambox.structures import Frame
from beambox.visualize.bev import Region
from beambox.visualize.picture import draw_sweep

WIDTH = 680
"""Pixels of a picture."""


class Scene(NamedTuple):
    """One simulated scene and what looks at it."""

    name: str
    model: str
    sensor: str
    view: str
    seed: int
    reach: float


SCENES = (
    Scene("street", "pointpillars-sim", "hdl64", "full", 11, 40.0),
    Scene("ahead", "voxel_rcnn-kitti", "hdl64", "camera", 4, 45.0),
    Scene("pandar", "pointpillars-kitti", "pandar64", "full", 3, 40.0),
    Scene("sparse", "pointpillars-sim", "hdl32", "full", 8, 30.0),
)


def simulated() -> Iterator[tuple[Scene, Frame]]:
    """Yield each scene with its sweep."""
    for scene in SCENES:
        yield scene, SimulatedSource(1, seed=scene.seed, sensor=scene.sensor, view=scene.view)[0]


def real(root: Path) -> Iterator[tuple[Scene, Frame]]:
    """Yield validation scans of KITTI that lie below a folder."""
    source = KittiSource(root, "val")
    for index in range(0, len(source), max(1, len(source) // 4)):
        yield Scene(f"kitti_{source.ids[index]}", "voxel_rcnn-kitti", "", "camera", 0, 50.0), source[index]


def picture(scene: Scene, frame: Frame) -> Image.Image:
    """Detect in a sweep and draw it, with ground truth."""
    around = scene.reach if scene.view == "full" else None
    detector = beambox.load(scene.model, precision="float32", view=scene.view, range=around)
    sure = detector(frame).above(0.3)
    reach = scene.reach
    behind, side = (reach, reach) if scene.view == "full" else (5.0, reach / 2)
    region = Region(-behind, -side, reach, side)
    drawn = draw_sweep(frame, sure, frame.labels, region=region, title=f"{scene.name}: {scene.model}")
    drawn.thumbnail((WIDTH, WIDTH * 2), Image.Resampling.LANCZOS)
    return drawn.convert("P", palette=Image.Palette.ADAPTIVE, colors=128)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path(__file__).with_name("pictures"))
    parser.add_argument("--kitti", type=Path, help="a folder of KITTI: draw four of its validation scans instead")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for scene, frame in real(asked.kitti) if asked.kitti else simulated():
        path = asked.out / f"gallery_{scene.name}.png"
        picture(scene, frame).save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
