"""Ground truth of one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, overload

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_finite, expect_same_length, expect_shape
from beambox.geometry.boxes import corners_3d
from beambox.geometry.calibration import Calibration
from beambox.structures import conversions, rows
from beambox.structures.selecting import Index, as_numbers, floats, integers, positions, rows_of, same_fields

if TYPE_CHECKING:
    import numpy as np
    import pandas  # pyright: ignore[reportMissingTypeStubs]
    from numpy.typing import ArrayLike
    from PIL.Image import Image

    from beambox.structures.frame import Frame

__all__ = ["ImageAttributes", "Label", "Labels"]

COLUMNS = ("name", *rows.BOX)


@dataclass(frozen=True, eq=False)
class ImageAttributes:
    """What KITTI's label files say of each object beyond its box; length N."""

    truncation: Tensor
    """``(N,)`` share of the object outside the image, 0 to 1."""
    occlusion: Tensor
    """``(N,)`` int64: 0 visible, 1 partly, 2 largely occluded, 3 unknown."""
    alpha: Tensor
    """``(N,)`` observation angle, radians."""
    image: Tensor
    """``(N, 4)`` left, top, right, bottom in pixels."""
    camera: Tensor | None = None
    """``(N, 7)`` float64 h, w, l, x, y, z, rotation_y exactly as a label file has them (bottom centre in the rectified
    camera frame; metres, radians), or None where the boxes did not come from one."""

    def __post_init__(self) -> None:
        expect_shape("image", self.image, ("N", 4))
        expect_same_length(
            truncation=len(self.truncation), occlusion=len(self.occlusion), alpha=len(self.alpha), image=len(self.image)
        )
        if self.camera is not None:
            expect_shape("camera", self.camera, (len(self.image), 7))

    def __getitem__(self, index: Tensor | slice) -> ImageAttributes:
        camera = None if self.camera is None else self.camera[index]
        return ImageAttributes(
            self.truncation[index], self.occlusion[index], self.alpha[index], self.image[index], camera
        )

    def __eq__(self, other: object) -> bool:
        """Whether every field is equal, value by value."""
        if not isinstance(other, ImageAttributes):
            return NotImplemented
        return same_fields(self, other)

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # tensors can be changed in place

    def difficulty(self) -> Tensor:
        """KITTI's level of each object, ``(N,)`` int64: 0 easy, 1 moderate, 2 hard, -1 beyond hard (the devkit)."""
        height = self.image[:, 3] - self.image[:, 1] + 1
        level = torch.full((len(self.image),), -1)
        for rank, (tall, cut, hidden) in reversed(list(enumerate(((40, 0.15, 0), (25, 0.30, 1), (25, 0.50, 2))))):
            fits = (height >= tall) & (self.truncation <= cut) & (self.occlusion <= hidden)
            level[fits] = rank
        return level


@dataclass(frozen=True)
class Label:
    """One labelled object: what ``labels[0]`` and a loop over labels give."""

    name: str
    """Class."""
    box: tuple[float, ...]
    """x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""


@dataclass(frozen=True, eq=False, repr=False)
class Labels:
    """Boxes of the objects in a frame and their class names; behaves like a sequence."""

    boxes: Tensor
    """``(N, 7)`` float32 x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""
    names: tuple[str, ...]
    """Class of each box."""
    attributes: ImageAttributes | None = None
    """KITTI's further columns, where the data has them."""
    ignored_image: Tensor = field(default_factory=lambda: torch.zeros(0, 4))
    """``(K, 4)`` image regions that nobody labelled (KITTI's DontCare), pixels."""

    if TYPE_CHECKING:  # what may be passed; the fields hold tensors

        def __init__(
            self,
            boxes: Tensor | ArrayLike,
            names: Sequence[str],
            attributes: ImageAttributes | None = None,
            ignored_image: Tensor = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        boxes = as_numbers("boxes", self.boxes, torch.float32).to(torch.float32)
        object.__setattr__(self, "boxes", boxes.reshape(0, 7) if not boxes.numel() and boxes.dim() < 2 else boxes)
        if isinstance(self.names, str):
            raise BeamboxError(f'`names` must be a sequence with one name per box, got the text "{self.names}"')
        object.__setattr__(self, "names", tuple(self.names))
        expect_shape("boxes", self.boxes, ("N", 7))
        expect_finite("boxes", self.boxes)
        expect_same_length(boxes=len(self.boxes), names=len(self.names))
        if bool((self.boxes[:, 3:6] < 0).any()):
            raise BeamboxError("`boxes` must have sizes of at least 0, got a negative length, width or height")
        if self.attributes is not None:
            expect_same_length(boxes=len(self.boxes), attributes=len(self.attributes.image))

    # --- as a sequence ------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: Index) -> Labels: ...  # pyright: ignore[reportOverlappingOverload]
    @overload
    def __getitem__(self, index: SupportsIndex) -> Label: ...
    def __getitem__(self, index: SupportsIndex | Index) -> Label | Labels:
        """Select: a number gives one :class:`Label`; a slice, a mask or positions give labels."""
        chosen = positions(index, len(self))
        if isinstance(chosen, int):
            return Label(self.names[chosen], tuple(floats(self.boxes[chosen])))
        attributes = None if self.attributes is None else self.attributes[chosen]
        names = tuple(self.names[i] for i in integers(chosen))
        return replace(self, boxes=self.boxes[chosen], names=names, attributes=attributes)

    def __iter__(self) -> Iterator[Label]:
        """Yield each :class:`Label`, in order."""
        return (Label(name, tuple(box)) for name, box in zip(self.names, rows_of(self.boxes)))

    def __eq__(self, other: object) -> bool:
        """Whether every field is equal, tensors value by value."""
        if not isinstance(other, Labels):
            return NotImplemented
        return same_fields(self, other)

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # tensors can be changed in place

    def __repr__(self) -> str:
        return f"Labels({len(self)}: {rows.counted(self.names)})"

    def _repr_html_(self) -> str:
        """Show a bird's-eye view in a notebook."""
        return conversions.html_of(repr(self), self.plot())

    # --- what is known ------------------------------------------------------------------------------------------------

    @property
    def corners(self) -> Tensor:
        """``(N, 8, 3)`` corners of the boxes, metres; ordered as :func:`beambox.geometry.corners_3d` says."""
        return corners_3d(self.boxes)

    @property
    def distances(self) -> Tensor:
        """``(N,)`` metres from the origin of the LiDAR frame to the centers of the boxes, in 3-D."""
        return self.boxes[:, :3].square().sum(dim=1).sqrt()

    def class_index(self, classes: Sequence[str]) -> Tensor:
        """Return each object's position in ``classes``, or -1: ``(N,)`` int64."""
        place = {name: i for i, name in enumerate(classes)}
        return torch.tensor([place.get(name, -1) for name in self.names], dtype=torch.int64)

    # --- selections and copies ----------------------------------------------------------------------------------------

    def of_classes(self, classes: str | Sequence[str]) -> Labels:
        """Keep the objects of one class or several; a class that does not occur keeps none."""
        wanted = [classes] if isinstance(classes, str) else list(classes)
        return self[torch.tensor([name in wanted for name in self.names], dtype=torch.bool)]

    def with_boxes(self, boxes: Tensor) -> Labels:
        """Return the same objects at other places (image attributes no longer hold and are dropped)."""
        return Labels(boxes, self.names)

    @classmethod
    def empty(cls) -> Labels:
        """No objects."""
        return cls(torch.zeros(0, 7), ())

    # --- to and from other forms --------------------------------------------------------------------------------------

    def to_rows(self) -> list[dict[str, float | str]]:
        """Return one flat record per object, in the LiDAR frame, for JSON and CSV."""
        return [{"name": one.name, **dict(zip(rows.BOX, one.box))} for one in self]

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Return arrays: ``boxes`` (N, 7) and ``names`` (N,)."""
        import numpy as np

        return {"boxes": self.boxes.detach().cpu().numpy(), "names": np.array(self.names, dtype=str)}

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with the columns name, x, y, z, l, w, h, yaw (needs pandas)."""
        return rows.frame_of_rows(self.to_rows(), COLUMNS)

    def to_json(self) -> str:
        """Write JSON: an object with the list ``objects``; metres and radians."""
        return rows.json_text(rows.rounded(self.to_rows()), {}, "objects")

    @classmethod
    def from_json(cls, text: str, where: str = "the text") -> Labels:
        """Read what :meth:`to_json` wrote; ``where`` is what errors call it."""
        return _from_rows(rows.parse_json(text, where, "objects", COLUMNS)[1])

    def to_csv(self) -> str:
        """Write CSV with a header line: name, x, y, z, l, w, h, yaw (a label file of one's own data)."""
        return rows.csv_text(rows.rounded(self.to_rows()), COLUMNS)

    @classmethod
    def from_csv(cls, text: str, where: str = "the text") -> Labels:
        """Read what :meth:`to_csv` wrote; ``where`` is what errors call it."""
        return _from_rows(rows.parse_csv(text, where, COLUMNS))

    def to_kitti(self, calibration: Calibration, image_size: tuple[int, int] | None = None) -> str:
        """Write the lines of a KITTI label file; what the labels do not know is computed from the boxes."""
        return conversions.labels_to_kitti(self, calibration, image_size)

    @classmethod
    def from_kitti(cls, text: str, calibration: Calibration) -> Labels:
        """Read the lines of a KITTI label file."""
        return conversions.labels_from_kitti(text, calibration)

    def plot(self, frame: Frame | None = None, **options: Any) -> Image:
        """Draw a bird's-eye view, over the points of ``frame`` where given; see :func:`beambox.draw`."""
        return conversions.plot(frame, None, self, **options)

    def save(self, path: str | Path, *, frame: Frame | None = None, calibration: Calibration | None = None) -> Path:
        """Write a file; its ending says what: .json, .csv, .txt (KITTI), .png, .jpg or .html (a picture, a viewer).

        Args:
            path: where to; folders are made.
            frame: points below the picture, and the calibration for KITTI's format.
            calibration: for KITTI's format, where the frame has none.

        Raises:
            BeamboxError: for another ending, or KITTI's format without a calibration.
        """
        return conversions.save_labels(self, Path(path), frame, calibration)


def _from_rows(found: Sequence[dict[str, Any]]) -> Labels:
    boxes = torch.tensor([[row[key] for key in rows.BOX] for row in found], dtype=torch.float32).reshape(-1, 7)
    return Labels(boxes, [row["name"] for row in found])
