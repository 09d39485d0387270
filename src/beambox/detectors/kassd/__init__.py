"""KASSD in three files: ``network.py`` reads as the paper does; ``keypoints.py`` is the geometry of its keypoints."""

from beambox.detectors.kassd.keypoints import ExtraPoint, KeypointLayout
from beambox.detectors.kassd.network import (
    KamOptions,
    KamScore,
    Kassd,
    KassdConfig,
    KassdPredictions,
    LamReduce,
    Neck,
    kassd,
)

__all__ = [
    "ExtraPoint",
    "KamOptions",
    "KamScore",
    "Kassd",
    "KassdConfig",
    "KassdPredictions",
    "KeypointLayout",
    "LamReduce",
    "Neck",
    "kassd",
]
