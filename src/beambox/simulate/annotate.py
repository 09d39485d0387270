"""Labels of a simulated frame as KITTI's annotators would write them: truncation, occlusion, image boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from beambox.geometry.calibration import Calibration
from beambox.simulate.raycast import Placed
from beambox.structures.labels import ImageAttributes, Labels

__all__ = ["PARTLY", "annotate", "occlusion_level"]

PARTLY, LARGELY, UNKNOWN = 0.15, 0.50, 0.92
"""Shares of an object's beams lost to others from which it is partly or largely occluded, or hard to tell."""


def occlusion_level(unoccluded_hits: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """KITTI's occlusion of each object: 0 visible, 1 partly, 2 largely occluded, 3 unknown.

    Args:
        unoccluded_hits: ``(O,)`` beams that would meet the object were nothing else there.
        hits: ``(O,)`` beams that do.
    """
    lost = 1.0 - hits / np.maximum(unoccluded_hits, 1)
    return (lost >= PARTLY).astype(np.int64) + (lost >= LARGELY) + (lost >= UNKNOWN)


def annotate(
    placed: Sequence[Placed],
    unoccluded_hits: np.ndarray,
    hits: np.ndarray,
    calibration: Calibration,
    image_size: tuple[int, int],
    full: bool,
) -> Labels:
    """Label every object that a beam met and, unless ``full``, that the image shows at least in part.

    With ``full``, an object that the image does not show gets truncation 1 and the image box 0, 0, 0, 0.
    """
    chosen = [i for i, p in enumerate(placed) if p.name and hits[i] > 0]
    boxes = torch.tensor([placed[i].box for i in chosen], dtype=torch.float64).reshape(-1, 7)
    names = tuple(placed[i].name for i in chosen)
    wide, clipped = calibration.to_camera(boxes), calibration.to_camera(boxes, image_size)
    size = wide.image[:, 2:] - wide.image[:, :2]
    inside = (clipped.image[:, 2:] - clipped.image[:, :2]).clamp(min=0)
    truncation = 1 - (inside.prod(dim=1) / size.prod(dim=1).clamp(min=1e-6)).clamp(0, 1)
    shown = (wide.location[:, 2] > 0.5) & (inside.prod(dim=1) > 4) & (truncation < 0.95)
    image = torch.where(shown[:, None], clipped.image, torch.zeros(4, dtype=torch.float64))
    truncation = torch.where(shown, truncation, torch.ones_like(truncation))
    occlusion = torch.from_numpy(occlusion_level(unoccluded_hits[chosen], hits[chosen])).reshape(-1)
    labels = Labels(boxes.float(), names, ImageAttributes(truncation, occlusion, clipped.alpha, image))
    return labels if full else labels[shown]
