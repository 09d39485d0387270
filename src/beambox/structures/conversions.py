"""What the values become elsewhere: pictures, files, other libraries' types.

The types keep thin methods that call these functions. Each imports what it needs when it is called, so that a value
costs no drawing library; this is the one file of ``structures`` that may look into ``visualize`` and ``data``, and only
inside its functions.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from beambox.checks import BeamboxError
from beambox.geometry.calibration import Calibration
from beambox.io import write_bytes, write_text

if TYPE_CHECKING:
    from PIL.Image import Image

    from beambox.structures.detections import Detections
    from beambox.structures.frame import Frame
    from beambox.structures.labels import Labels

PICTURES = (".png", ".jpg", ".jpeg")


def html_of(caption: str, picture: Image) -> str:
    """Return HTML for a notebook: a picture and a line below it."""
    content = io.BytesIO()
    picture.convert("RGB").save(content, format="PNG")
    code = base64.b64encode(content.getvalue()).decode("ascii")
    return (
        f'<figure><img alt="bird\'s-eye view" style="max-width:100%" src="data:image/png;base64,{code}">'
        f"<figcaption><code>{html.escape(caption)}</code></figcaption></figure>"
    )


def plot(frame: Frame | None, detections: Detections | None, labels: Labels | None, **options: Any) -> Image:
    """Draw a bird's-eye view; without a frame there are no points."""
    from beambox.visualize.bev import draw_bev

    return draw_bev(_frame(frame, detections), detections, labels, **options)


def _frame(frame: Frame | None, detections: Detections | None = None) -> Frame:
    from beambox.structures.frame import Frame

    return frame or Frame(torch.zeros(0, 4), id="" if detections is None else detections.frame_id)


def save_detections(
    found: Detections, path: Path, frame: Frame | None, calibration: Calibration | None, model: str
) -> Path:
    """See :meth:`Detections.save`."""
    ending = path.suffix.lower()
    if ending == ".txt":
        known = calibration or (frame.calibration if frame else None)
        if known is None:
            raise BeamboxError("KITTI's format holds boxes in the camera's frame; give `calibration` or a `frame` that "
                               "has one, or write .json or .csv")  # fmt: skip
        return _write(path, found.to_kitti(known, frame.image_size if frame else None))
    if ending == ".json":
        return _write(path, found.to_json(model))
    if ending == ".csv":
        return _write(path, found.to_csv())
    return _save_picture(path, frame, found, None, ".json, .csv, .txt (KITTI)")


def save_labels(labels: Labels, path: Path, frame: Frame | None, calibration: Calibration | None) -> Path:
    """See :meth:`Labels.save`."""
    ending = path.suffix.lower()
    if ending == ".txt":
        known = calibration or (frame.calibration if frame else None)
        if known is None:
            raise BeamboxError("KITTI's label format holds boxes in the camera's frame; give `calibration` or a "
                               "`frame` that has one, or write .json or .csv")  # fmt: skip
        return _write(path, labels.to_kitti(known, frame.image_size if frame else None))
    if ending == ".json":
        return _write(path, labels.to_json())
    if ending == ".csv":
        return _write(path, labels.to_csv())
    return _save_picture(path, frame, None, labels, ".json, .csv, .txt (KITTI)")


def save_frame(frame: Frame, path: Path) -> Path:
    """See :meth:`Frame.save`."""
    ending = path.suffix.lower()
    if ending not in (".bin", ".npy"):
        return _save_picture(path, frame, None, frame.labels, ".bin, .npy")
    content = io.BytesIO()
    points = frame.points.detach().cpu().numpy()
    if ending == ".npy":
        np.save(content, points)
    else:
        content.write(points[:, :4].astype("<f4").tobytes())  # the format has four columns and no place to say more
    write_bytes(path, content.getvalue())
    return path


def _save_picture(
    path: Path, frame: Frame | None, detections: Detections | None, labels: Labels | None, others: str
) -> Path:
    if path.suffix.lower() == ".html":
        from beambox.visualize.viewer import viewer_html

        return _write(path, viewer_html(_frame(frame, detections), detections, labels))
    if path.suffix.lower() not in PICTURES:
        raise BeamboxError(f"{path.name}: a name ends in {others}, .png, .jpg or .html, got {path.suffix or 'nothing'}")
    from beambox.visualize.canvas import save_picture
    from beambox.visualize.picture import draw_sweep

    save_picture(draw_sweep(_frame(frame, detections), detections, labels), path)
    return path


def _write(path: Path, text: str) -> Path:
    write_text(path, text)
    return path


def detections_from_kitti(
    text: str, calibration: Calibration, classes: Sequence[str] | None, frame_id: str
) -> Detections:
    """See :meth:`Detections.from_kitti`."""
    from beambox.data.kitti_text import parse_results

    return parse_results(text, calibration, classes, frame_id or "results", frame_id)


def labels_from_kitti(text: str, calibration: Calibration) -> Labels:
    """See :meth:`Labels.from_kitti`."""
    from beambox.data.kitti_text import parse_labels

    return parse_labels(text, calibration)


def labels_to_kitti(labels: Labels, calibration: Calibration, image_size: tuple[int, int] | None) -> str:
    """See :meth:`Labels.to_kitti`."""
    from beambox.data.kitti_text import format_labels

    return format_labels(labels, calibration, image_size)


def points_of(array: Any, intensity_scale: float | None) -> tuple[torch.Tensor, tuple[str, ...]]:
    """See :meth:`Frame.from_array`."""
    from beambox.data.read_points import points_from_array

    return points_from_array(array, intensity_scale)


def frame_from_file(path: Path, fields: str | Sequence[str] | None, intensity_scale: float | None) -> Frame:
    """See :meth:`Frame.from_file`."""
    from beambox.data.read_points import read_frame

    return read_frame(path, fields=fields, intensity_scale=intensity_scale)


def to_supervision(found: Detections, calibration: Calibration, image_size: tuple[int, int] | None) -> Any:
    """See :meth:`Detections.to_supervision`."""
    try:
        supervision: Any = import_module("supervision")
    except ImportError:
        raise BeamboxError("this needs supervision, which is not installed: pip install supervision") from None
    boxes = found.boxes.detach().cpu()
    depth = calibration.lidar_to_rect(found.corners.detach().cpu().double().flatten(0, 1))[:, 2].reshape(-1, 8)
    seen = found[(depth > 0).all(dim=1)] if len(boxes) else found
    camera = calibration.to_camera(seen.boxes.detach().cpu(), image_size)
    arrays = seen.to_numpy()
    return supervision.Detections(
        xyxy=camera.image.float().reshape(-1, 4).numpy(),
        confidence=arrays["scores"],
        class_id=arrays["class_ids"],
        data={"class_name": arrays["names"], "box3d": arrays["boxes"]},
    )
