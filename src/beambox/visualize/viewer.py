"""One sweep to turn around in a browser; see :mod:`beambox.visualize.scene`, which also takes several."""

from __future__ import annotations

from beambox.structures import Detections, Frame, Labels
from beambox.visualize.scene import Scene, scene_html

__all__ = ["viewer_html"]


def viewer_html(
    frame: Frame, detections: Detections | None = None, labels: Labels | None = None, *, title: str = ""
) -> str:
    """Return a page that shows points and boxes in three dimensions.

    Args:
        frame: the points.
        detections: in the colour of their class.
        labels: the truth, in green; dashed where detections are shown, too.
        title: the frame's name where empty.
    """
    return scene_html([Scene(frame, detections, labels)], title=title)
