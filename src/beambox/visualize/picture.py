"""One picture of a sweep: its camera image above, where there is one, and the view from above."""

from __future__ import annotations

from PIL import Image

from beambox.structures import Detections, Frame, Labels
from beambox.visualize.bev import ColorBy, Region, draw_bev
from beambox.visualize.image import draw_camera, open_image

__all__ = ["draw_sweep"]


def draw_sweep(
    frame: Frame,
    detections: Detections | None = None,
    labels: Labels | None = None,
    *,
    region: Region | None = None,
    detection_range: Region | None = None,
    color_by: ColorBy = "height",
    title: str = "",
) -> Image.Image:
    """Draw a sweep in BEV and, where the frame has a camera image, the boxes in it; see :func:`draw_bev`.

    Boxes and points are in the same frame, that of the calibration where there is one.
    """
    bev = draw_bev(
        frame, detections, labels, region=region, detection_range=detection_range, color_by=color_by, title=title
    )
    if frame.calibration is None or frame.image_path is None:
        return bev
    camera = draw_camera(open_image(frame.image_path), frame.calibration, detections, labels)
    height = round(camera.height * bev.width / camera.width)
    both = Image.new("RGB", (bev.width, height + bev.height))
    both.paste(camera.resize((bev.width, height), Image.Resampling.LANCZOS), (0, 0))
    both.paste(bev, (0, height))
    return both
