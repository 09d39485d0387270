"""Sweeps in three dimensions in a browser: one HTML file that needs nothing else and can be sent to a colleague.

The page draws with three.js, a bundle of which lies in ``vendor/`` with its licence. Points are kept to the centimetre:
16 bits per axis, as differences between neighbors in the scan, deflated; some 4 to 6 bytes each as text.
"""

from __future__ import annotations

import base64
import html
import io
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beambox.checks import BeamboxError, printable
from beambox.structures import Detections, Frame, Labels
from beambox.visualize.colors import TRUTH, class_color, gradient
from beambox.visualize.image import open_image
from beambox.visualize.page import data_url, fill, script_json, template

__all__ = ["LARGEST_PAGE", "Scene", "scene_html"]

REACH = 327.0
"""Metres that whole centimetres in 16 bits can hold; points farther away are left out, and the page says so."""
LARGEST_PAGE = 4_000_000
"""Bytes of a page; several sweeps are thinned until they fit."""
THREE = "vendor/three-0.187.0.min.js"
CAMERA_WIDTH = 1000
"""Pixels of a camera picture's width at most."""
GROUND = -1.73
"""Height of the rings of distance, metres, where no plane is known."""


@dataclass(frozen=True)
class Scene:
    """One sweep of a page."""

    frame: Frame
    """The points; with a calibration and an image, the page shows the image, too."""
    detections: Detections | None = None
    """In the colour of their class."""
    labels: Labels | None = None
    """The truth, in green; dashed where detections are shown, too."""
    tracks: Sequence[int] | None = None
    """Track of each detection, where they were tracked."""

    def __post_init__(self) -> None:
        if self.tracks is not None and len(self.tracks) != (0 if self.detections is None else len(self.detections)):
            raise BeamboxError(f"`tracks` must name a track for each detection, got {len(self.tracks)}")


def scene_html(
    scenes: Sequence[Scene],
    *,
    title: str = "",
    score_threshold: float = 0.0,
    period: float = 0.2,
    largest: int = LARGEST_PAGE,
) -> str:
    """Return a page that shows sweeps in three dimensions, with a time line where there are several.

    Args:
        scenes: at least one sweep.
        title: the first frame's name where empty.
        score_threshold: where the slider of scores stands at first; all detections are in the page.
        period: seconds per sweep when played.
        largest: bytes of the page; points are left out evenly where there are more than fit.

    Raises:
        BeamboxError: if there is no sweep.
    """
    if not scenes:
        raise BeamboxError("a page needs at least one sweep, got none")
    three, script = template(THREE), template("scene.js")
    classes = _classes(scenes)
    cameras = _cameras(scenes, largest // 4)
    fixed = sum(len(camera["url"]) for camera in cameras if camera) + len(three) + len(script) + 30_000
    fixed += 130 * sum(len(part) for scene in scenes for part in (scene.detections, scene.labels) if part is not None)
    clouds = _clouds(scenes, largest - fixed)
    sweeps = []
    for scene, camera, cloud in zip(scenes, cameras, clouds):
        counts = _counts(scene, cloud["size"], cloud.pop("within"))
        boxes = _boxes(scene, {name: k for k, name in enumerate(classes)})
        sweeps.append({"name": scene.frame.id, "counts": counts, **cloud, "boxes": boxes, "camera": camera})
    content = {
        "sweeps": sweeps,
        "classes": [{"name": name, "colour": list(class_color(name))} for name in classes],
        "truth": list(TRUTH),
        "colours": gradient(np.linspace(0, 1, 256)).tolist(),
        "ground": GROUND,
        "score": score_threshold,
        "period": round(1000 * period),
    }
    name = html.escape(printable(title or scenes[0].frame.id or "sweep", 500))
    parts = {"TITLE": name, "DATA": script_json(content), "THREE": three, "SCRIPT": script}
    return fill(template("scene.html"), parts)


def _classes(scenes: Sequence[Scene]) -> list[str]:
    names: dict[str, None] = {}
    for scene in scenes:
        for part in (scene.detections, scene.labels):
            names.update(dict.fromkeys(() if part is None else part.names))
    return sorted(names)


def _clouds(scenes: Sequence[Scene], room: int) -> list[dict[str, Any]]:
    """Pack all points, or evenly as many of them as have room."""
    share = 1.0
    for _ in range(12):
        clouds = [_cloud(scene.frame.points, share) for scene in scenes]
        size = sum(len(cloud["xyz"]) + len(cloud["intensity"]) for cloud in clouds)
        if size <= room or share < 0.001:
            return clouds
        share *= min(0.97, 0.97 * max(room, 1) / size)
    return clouds


def _cloud(points: torch.Tensor, share: float) -> dict[str, Any]:
    values = points[:, :4].numpy()
    values = values[(np.abs(values[:, :3]) < REACH).all(axis=1)]
    within = len(values)
    if share < 1:
        values = (
            values[np.unique(np.linspace(0, within - 1, max(1, round(share * within))).astype(np.int64))]
            if within
            else values
        )
    centimeters = np.round(values[:, :3] * 100).astype(np.int16)
    planes = []
    for axis in range(3):
        steps = np.diff(centimeters[:, axis], prepend=np.int16(0)).astype("<u2")  # wraps around, as the page's sums do
        planes += [(steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8)]
    return {
        "size": len(values),
        "within": within,
        "xyz": _packed(np.concatenate(planes)),
        "intensity": _packed(_shade(values[:, 3])),
    }


def _packed(array: NDArray[np.uint8]) -> str:
    return base64.b64encode(zlib.compress(array.tobytes(), 6)).decode("ascii")


def _shade(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Spread values over 256 shades, without the two in a hundred at each end."""
    values = np.nan_to_num(values)
    if not len(values):
        return np.zeros(0, dtype=np.uint8)
    low, high = np.quantile(values, (0.02, 0.98))
    return (255 * np.clip((values - low) / max(high - low, 1e-3), 0, 1)).astype(np.uint8)


def _boxes(scene: Scene, kinds: dict[str, int]) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    if scene.labels is not None:
        for box, name in zip(scene.labels.boxes.tolist(), scene.labels.names):
            out.append({"box": _rounded(box), "kind": kinds[name], "truth": True})
    if scene.detections is not None:
        found = scene.detections
        tracks = [None] * len(found) if scene.tracks is None else [int(track) for track in scene.tracks]
        for box, name, score, track in zip(found.boxes.cpu().tolist(), found.names, found.scores.tolist(), tracks):
            one = {"box": _rounded(box), "kind": kinds[name], "truth": False, "score": round(score, 4)}
            out.append(one if track is None else {**one, "track": track})
    return out


def _cameras(scenes: Sequence[Scene], room: int) -> list[dict[str, Any] | None]:
    """Encode the camera pictures, smaller where there are many, with what carries a point into each."""
    there = [s.frame.calibration is not None and s.frame.image_path is not None for s in scenes]
    width, quality = CAMERA_WIDTH, 80
    cameras: list[dict[str, Any] | None] = []
    for _ in range(5):
        cameras = [_camera(scene.frame, width, quality) if each else None for scene, each in zip(scenes, there)]
        if sum(len(camera["url"]) for camera in cameras if camera) <= room:
            return cameras
        width, quality = round(width * 0.7), 70
    return [None] * len(scenes)  # hundreds of sweeps: points are worth more


def _camera(frame: Frame, width: int, quality: int) -> dict[str, Any]:
    assert frame.calibration is not None and frame.image_path is not None
    picture = open_image(frame.image_path)
    full = picture.width
    picture.thumbnail((width, width))
    stream = io.BytesIO()
    picture.save(stream, format="JPEG", quality=quality)
    to_rect = frame.calibration.lidar_to_rect_matrix
    matrix = torch.cat((frame.calibration.p2[:2] @ to_rect, to_rect[2:3]))  # (3, 4): u * depth, v * depth, depth
    matrix[:2] *= picture.width / full
    return {
        "url": data_url(stream.getvalue(), "image/jpeg"),
        "matrix": [[round(v, 7) for v in row] for row in matrix.tolist()],
    }


def _counts(scene: Scene, shown: int, within: int) -> str:
    total = len(scene.frame)
    words = [f"{total:,} points"]
    words += [f"{total - within:,} farther than {REACH:.0f} m left out"] if within < total else []
    words += [f"{shown:,} of them shown"] if shown < within else []
    words += [] if scene.detections is None else [f"{len(scene.detections)} detections"]
    words += [] if scene.labels is None else [f"{len(scene.labels)} labelled objects"]
    return ", ".join(words)


def _rounded(box: list[float]) -> list[float]:
    return [round(value, 3) for value in box]
