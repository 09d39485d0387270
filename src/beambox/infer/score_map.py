"""The class scores of a network as a map in BEV, beside its detections."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from beambox.checks import BeamboxError
from beambox.detectors.kassd import KASSDPredictions
from beambox.detectors.voxel_rcnn import VoxelRCNNPredictions
from beambox.infer.predictor import Detector
from beambox.structures import Batch, Detections, Frame

__all__ = ["detect_with_scores", "score_map"]


@torch.inference_mode()
def detect_with_scores(detector: Detector, frame: Frame) -> tuple[Detections, NDArray[np.float32] | None]:
    """Detect in a sweep, and return the largest class score of each place.

    Returns:
        The detections, and ``(X, Y)`` scores in [0, 1], x forward up and y to the left; None where the network looks at
        no point.
    """
    prepared = detector.prepare(frame)
    if not detector.sees(prepared):
        return Detections.empty(detector.classes, frame.id), None
    predictions = detector.predict(Batch.of([prepared]).to(detector.device))
    scores = score_map(detector, predictions)[0]  # (Y, X)
    return detector.finish(predictions, [frame])[0], scores.T.flip(0, 1).numpy()


def score_map(detector: Detector, predictions: object) -> Tensor:
    """Return the largest class score of each place's anchors, ``(B, Y, X)`` in [0, 1]; rows are y, columns x.

    Args:
        detector: who predicted.
        predictions: of its network; of two stages, those of the first are shown.
    """
    head: Any = predictions
    if isinstance(predictions, KASSDPredictions):
        head = predictions.head
    elif isinstance(predictions, VoxelRCNNPredictions):
        head = predictions.first
    anchors: Any = getattr(detector.model, "anchors", None)
    if anchors is None or not hasattr(head, "cls"):
        raise BeamboxError(f"{type(detector.model).__name__} has no anchors, so it has no map of scores")
    rows, columns = anchors.map_size(detector.grid)
    best = torch.sigmoid(head.cls.float()).amax(dim=2)  # (B, N), anchors in the order (y, x, class, rotation)
    return best.view(len(best), rows, columns, -1).amax(dim=3).cpu()
