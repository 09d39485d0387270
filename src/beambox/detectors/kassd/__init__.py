"""KASSD in three files: ``network.py`` reads as the paper does; ``keypoints.py`` is the geometry of its keypoints."""

from beambox.detectors.kassd.keypoints import ExtraPoint, KeypointLayout
from beambox.detectors.kassd.network import (
    KASSD,
    KamOptions,
    KamScore,
    KASSDConfig,
    KASSDPredictions,
    LamReduce,
    Neck,
    kassd,
)

__all__ = [
    "KASSD",
    "ExtraPoint",
    "KASSDConfig",
    "KASSDPredictions",
    "KamOptions",
    "KamScore",
    "KeypointLayout",
    "LamReduce",
    "Neck",
    "kassd",
]
