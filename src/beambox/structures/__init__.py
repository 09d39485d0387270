"""Values that validate at birth and slice like sequences."""

from beambox.structures.batch import Batch
from beambox.structures.detections import Detections
from beambox.structures.frame import Frame
from beambox.structures.labels import ImageAttributes, Labels

__all__ = ["Batch", "Detections", "Frame", "ImageAttributes", "Labels"]
