"""Values that validate at birth and behave like sequences."""

from beambox.structures.batch import Batch, expect_columns
from beambox.structures.detections import Detection, Detections
from beambox.structures.frame import Frame
from beambox.structures.labels import ImageAttributes, Label, Labels

__all__ = ["Batch", "Detection", "Detections", "Frame", "ImageAttributes", "Label", "Labels", "expect_columns"]
