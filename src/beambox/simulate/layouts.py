"""Where objects stand: random streets, or the real layouts of KITTI's label files with scenery made up around them."""

from __future__ import annotations

import math
import tarfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError, MissingFileError
from beambox.data.kitti import parse_calibration, parse_labels
from beambox.geometry.calibration import Calibration
from beambox.simulate.ground import Ground, Road
from beambox.simulate.materials import Palette
from beambox.simulate.object_mix import KITTI_MIX, SIZES, ObjectMix
from beambox.simulate.stage import Stage
from beambox.simulate.streets import add_scenery, random_ground, random_street
from beambox.structures.labels import Labels

__all__ = ["KittiLayout", "check_layout", "layout_frames", "scene"]


@dataclass(frozen=True)
class KittiLayout:
    """The objects of one KITTI frame."""

    id: str
    """Name of the frame."""
    labels: Labels
    """Its objects."""
    calibration: Calibration
    """Its camera."""


def check_layout(layout: str) -> tuple[str, str]:
    """Split ``random``, ``kitti:PATH`` or ``mixed:PATH`` (every second frame of each) into kind and path.

    Raises:
        BeamboxError: another kind.
        MissingFileError: the path is not there.
    """
    kind, _, path = layout.partition(":")
    if kind not in ("random", "kitti", "mixed") or (kind == "random") != (not path):
        raise BeamboxError(f"`layout` must be random, kitti:PATH or mixed:PATH, got {layout!r}")
    if path and not Path(path).exists():
        raise MissingFileError(
            f"layout {path} is not there; give a folder or .tar.gz archive with training/label_2 and training/calib"
        )
    return kind, path


@lru_cache(maxsize=2)
def layout_frames(path: str, split: str | None = "train") -> tuple[tuple[str, str, str], ...]:
    """Read a folder or archive of KITTI's training/label_2 and training/calib.

    Args:
        path: the folder or .tar(.gz) archive.
        split: where ImageSets/{split}.txt is there, only its frames are read; None reads all.

    Returns:
        id, text of the labels and text of the calibration of every frame, by id.

    Raises:
        BeamboxError: no frame was found, or the archive cannot be read.
    """
    texts = _archive_texts(Path(path)) if Path(path).is_file() else _folder_texts(Path(path))
    wanted = None if split is None else texts.get(f"ImageSets/{split}.txt")
    ids = sorted(n[-1][:-4] for n in (name.split("/") for name in texts) if n[-2] == "label_2")
    if wanted is not None:
        kept = set(wanted.split())
        ids = [i for i in ids if i in kept]
    frames = tuple((i, texts[f"label_2/{i}.txt"], texts[f"calib/{i}.txt"]) for i in ids if f"calib/{i}.txt" in texts)
    if not frames:
        raise BeamboxError(
            f"layout {path} holds no frame; expected training/label_2/ID.txt and training/calib/ID.txt"
            + (f" of ImageSets/{split}.txt" if wanted is not None else "")
        )
    return frames


def _short(name: str) -> str | None:
    """The last two parts of a file name where they are of interest."""
    parts = Path(name).as_posix().split("/")
    keep = len(parts) > 1 and parts[-1].endswith(".txt") and parts[-2] in ("label_2", "calib", "ImageSets")
    return "/".join(parts[-2:]) if keep else None


def _archive_texts(path: Path) -> dict[str, str]:
    texts: dict[str, str] = {}
    try:
        with tarfile.open(path) as archive:
            for member in archive:
                short = _short(member.name)
                data = archive.extractfile(member) if short and member.isfile() else None
                if short and data:
                    texts[short] = data.read().decode("utf-8")
    except (tarfile.TarError, EOFError, OSError) as error:
        raise BeamboxError(f"layout {path} cannot be read as a tar archive: {error}") from error
    return texts


def _folder_texts(path: Path) -> dict[str, str]:
    files = [*path.rglob("label_2/*.txt"), *path.rglob("calib/*.txt"), *path.rglob("ImageSets/*.txt")]
    return {short: f.read_text(encoding="utf-8") for f in sorted(files) if (short := _short(f.as_posix()))}


def pick_layout(path: str, split: str | None, rng: np.random.Generator) -> KittiLayout:
    """Draw one frame of a folder or archive."""
    frames = layout_frames(path, split)
    name, labels, calibration = frames[rng.integers(len(frames))]
    parsed = parse_calibration(calibration, f"{path}: calib/{name}.txt")
    return KittiLayout(name, parse_labels(labels, parsed, f"{path}: label_2/{name}.txt"), parsed)


def scene(
    rng: np.random.Generator, height: float, full: bool, layout: KittiLayout | None, object_mix: ObjectMix = KITTI_MIX
) -> Stage:
    """Build a scene: a random street, or the objects of a KITTI frame amid made-up scenery.

    Args:
        rng: source of all choices.
        height: of the sensor, metres.
        full: whether things stand behind the sensor too.
        layout: the objects; None for a random street.
        object_mix: which objects a random street holds.
    """
    palette = Palette(rng)
    ahead = -_BEHIND if full else 0.0
    if layout is None:
        roads = _random_roads(rng)
        stage = Stage(random_ground(roads, rng, height), palette, rng, ahead, object_mix=object_mix)
        random_street(stage, roads)
        return stage
    boxes = layout.labels.boxes.numpy().astype(np.float64)
    road = _road_under(boxes, rng)
    stage = Stage(_ground_under(boxes, road, rng, height), palette, rng, ahead, guard=True)
    for name, box in zip(layout.labels.names, boxes):
        if name in SIZES and (box[3:6] > 0.2).all() and math.hypot(box[0], box[1]) < 85:
            stage.add_object(name, box[0], box[1], box[6], tuple(box[3:6]), box[2] - box[5] / 2, force=True)
    add_scenery(stage, road)
    return stage


_BEHIND = 60.0


def _random_roads(rng: np.random.Generator) -> tuple[Road, ...]:
    half = rng.uniform(2.8, 7.5)
    kerb = rng.choice([0.0, rng.uniform(0.03, 0.16)], p=[0.2, 0.8])
    pavement = rng.choice([0.0, rng.uniform(0.8, 5.0)], p=[0.2, 0.8])
    offset = rng.uniform(0.1, 0.6) * half if half > 3.5 else rng.uniform(-0.5, 1.0)
    bend = rng.choice([0.0, rng.normal(0, 0.003)])
    first = Road(
        rng.normal(0, 0.06), offset, half, kerb, pavement, bend, rng.uniform(2.8, 3.7), float(rng.random() < 0.6)
    )
    if rng.random() < 0.35:
        turn = rng.choice([-1.0, 1.0]) * (math.pi / 2 + rng.normal(0, 0.2))
        away = -math.copysign(rng.uniform(8, 35), turn)
        second = Road(turn, away, rng.uniform(2.8, 6.0), kerb, pavement, 0.0, 3.3, float(rng.random() < 0.5))
        return first, second
    return (first,)


def _road_under(boxes: np.ndarray, rng: np.random.Generator) -> Road:
    """A road along the commonest heading of the vehicles, as wide as they are spread."""
    vehicles = boxes[(boxes[:, 3] > 2.5)]
    angle = 0.0
    if len(vehicles):
        folded = vehicles[:, 6] - np.pi * np.round(vehicles[:, 6] / np.pi)
        aligned = folded[np.abs(folded) < 0.5]
        angle = float(np.median(aligned)) if len(aligned) else 0.0
        folded = folded - angle
        vehicles = vehicles[np.abs(folded) < 0.3]
    across = -np.sin(angle) * vehicles[:, 0] + np.cos(angle) * vehicles[:, 1]
    across = across[np.abs(across) < 14]
    left = max(float(across.max(initial=0.0)) + 1.2, rng.uniform(2.0, 6.0))
    right = min(float(across.min(initial=0.0)) - 1.2, -rng.uniform(1.8, 4.5))
    kerb = rng.choice([0.0, rng.uniform(0.03, 0.16)], p=[0.25, 0.75])
    return Road(
        angle, (left + right) / 2, (left - right) / 2, kerb, rng.uniform(0.0, 4.0), 0.0, 3.3, float(rng.random() < 0.6)
    )


def _ground_under(boxes: np.ndarray, road: Road, rng: np.random.Generator, height: float) -> Ground:
    """A ground that passes under the boxes: slopes and bends fitted to their bottoms by ridge regression."""
    base = random_ground((road,), rng, height)
    x, y, bottom = boxes[:, 0], boxes[:, 1], boxes[:, 2] - boxes[:, 5] / 2
    fade = 1 + (x * x + y * y) / 4900.0
    design = np.stack((np.ones_like(x), x, y, x * x / fade, y * y / fade), axis=1)
    prior = np.array([base.height, *base.slope, 0.0, 0.0])
    spread = np.array([0.03, 0.006, 0.010, 0.0003, 0.0003])
    weight = 1 / 0.06**2
    normal = design.T @ design * weight + np.diag(1 / spread**2)
    fit = prior + np.linalg.solve(normal, design.T @ (bottom - design @ prior) * weight)
    waves = base.waves * np.array([0.4, 1, 1, 1])
    return Ground(float(fit[0]), (fit[1], fit[2]), (fit[3], fit[4]), waves, (road,), 0.02, base.bank, base.bank_limit,
                  base.roughness)  # fmt: skip
