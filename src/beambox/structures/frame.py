"""One sweep and what is known of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, overload

import torch
from torch import Tensor

from beambox.checks import BeamboxError, expect_dtype, printable
from beambox.geometry.calibration import Calibration
from beambox.structures import conversions, rows
from beambox.structures.detections import Detections
from beambox.structures.labels import Labels
from beambox.structures.selecting import Index, as_numbers, positions, same_fields

if TYPE_CHECKING:
    import numpy as np
    import pandas  # pyright: ignore[reportMissingTypeStubs]
    from numpy.typing import ArrayLike
    from PIL.Image import Image

__all__ = ["Frame"]


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """A LiDAR sweep, a sequence of points; labels and camera are optional.

    ``points`` takes a float32 tensor or any array of numbers as it is; :meth:`from_array` also fills in a missing
    intensity and brings it to [0, 1].
    """

    points: Tensor
    """``(N, 4 or more)`` float32: x, y, z in metres (LiDAR frame), intensity in [0, 1], then any further fields."""
    id: str = ""
    """Name of the frame, unique in its data set."""
    labels: Labels | None = None
    """Ground truth, or None where nobody labelled the frame."""
    calibration: Calibration | None = None
    """Camera calibration, where there is one."""
    image_path: Path | None = None
    """Camera image, where there is one."""
    image_size: tuple[int, int] | None = None
    """(width, height) of the camera image in pixels."""
    plane: Tensor | None = None
    """``(4,)`` road plane a, b, c, d with ax + by + cz + d = 0 in the LiDAR frame, unit normal pointing up."""
    notes: tuple[str, ...] = ()
    """What reading had to decide: points dropped, intensity scaled or filled."""

    if TYPE_CHECKING:  # what may be passed; the fields hold tensors

        def __init__(
            self,
            points: Tensor | ArrayLike,
            id: str = "",
            labels: Labels | None = None,
            calibration: Calibration | None = None,
            image_path: Path | None = None,
            image_size: tuple[int, int] | None = None,
            plane: Tensor | None = None,
            notes: tuple[str, ...] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        if not isinstance(self.points, Tensor):  # pyright: ignore[reportUnnecessaryIsInstance]  # arrays are taken too
            object.__setattr__(self, "points", as_numbers("points", self.points, torch.float32))
        if self.points.dim() != 2 or self.points.shape[1] < 4:
            raise BeamboxError(
                f"`points` must have shape (N, 4 or more): x, y, z, intensity; got {tuple(self.points.shape)}"
            )
        expect_dtype("points", self.points, torch.float32)

    @classmethod
    def from_array(cls, array: Tensor | ArrayLike, *, id: str = "", intensity_scale: float | None = None) -> Frame:
        """Make a frame of points in memory, by the rules for files (:mod:`beambox.data.read_points`).

        Args:
            array: ``(N, 3 or more)`` x, y, z in metres (LiDAR frame), intensity; further columns are left out.
            id: name of the frame.
            intensity_scale: factor that brings the intensity to [0, 1]; found from the numbers where None.

        Raises:
            BeamboxError: if it holds no points.
        """
        import numpy as np

        numbers = array if isinstance(array, Tensor) else np.asarray(array)
        points, notes = conversions.points_of(numbers, intensity_scale)
        return cls(points, id, notes=notes)

    @classmethod
    def from_file(
        cls, path: str | Path, *, fields: str | Sequence[str] | None = None, intensity_scale: float | None = None
    ) -> Frame:
        """Read a sweep from a file of any known format; see :func:`beambox.read_frame`."""
        return conversions.frame_from_file(Path(path), fields, intensity_scale)

    # --- as a sequence of points --------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.points)

    @overload
    def __getitem__(self, index: Index) -> Frame: ...  # pyright: ignore[reportOverlappingOverload]
    @overload
    def __getitem__(self, index: SupportsIndex) -> Tensor: ...
    def __getitem__(self, index: SupportsIndex | Index) -> Tensor | Frame:
        """Select points: a number gives one ``(C,)`` point; a slice, a mask or positions give a frame of them."""
        chosen = positions(index, len(self))
        return self.points[chosen] if isinstance(chosen, int) else self.with_points(self.points[chosen])

    def __iter__(self) -> Iterator[Tensor]:
        """Yield each ``(C,)`` point."""
        return iter(self.points)

    def __eq__(self, other: object) -> bool:
        """Whether every field is equal, tensors value by value."""
        if not isinstance(other, Frame):
            return NotImplemented
        return same_fields(self, other)

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # tensors can be changed in place

    def __repr__(self) -> str:
        parts = [f"{len(self):,} points with {self.points.shape[1]} columns"]
        parts += [f"{len(self.labels)} labels"] if self.labels is not None else []
        parts += ["calibration"] if self.calibration is not None else []
        parts += ["image"] if self.image_path is not None else []
        return f"Frame({printable(self.id[:60]) or 'unnamed'}: {', '.join(parts)})"

    def _repr_html_(self) -> str:
        """Show a bird's-eye view in a notebook."""
        return conversions.html_of(repr(self), self.plot())

    # --- copies -------------------------------------------------------------------------------------------------------

    def with_points(self, points: Tensor) -> Frame:
        """Return the same frame with other points."""
        return replace(self, points=points)

    def camera_view(self) -> Frame:
        """Keep only the points that the camera sees (KITTI labels exist only there).

        Raises:
            BeamboxError: without a calibration or an image size.
        """
        if self.calibration is None or self.image_size is None:
            raise BeamboxError(
                f"frame {self.id or '(unnamed)'} has no camera calibration, so its points cannot be cropped to the "
                "camera's view; give the calib file or keep all points"
            )
        return self.with_points(self.points[self.calibration.in_view(self.points, self.image_size)])

    # --- to other forms -----------------------------------------------------------------------------------------------

    def to_numpy(self) -> np.ndarray:
        """Return the points, ``(N, C)`` float32."""
        return self.points.detach().cpu().numpy()

    def to_pandas(self) -> pandas.DataFrame:
        """Return the points as a table: x, y, z, intensity, then column 5 and so on (needs pandas)."""
        names = ["x", "y", "z", "intensity", *(f"column {k}" for k in range(5, self.points.shape[1] + 1))]
        return rows.frame_of_array(self.to_numpy(), names)

    def plot(self, detections: Detections | None = None, **options: Any) -> Image:
        """Draw a bird's-eye view with the frame's labels, and detections where given; see :func:`beambox.draw`."""
        return conversions.plot(self, detections, self.labels, **options)

    def save(self, path: str | Path) -> Path:
        """Write a file; its ending says what: .bin (four columns), .npy, .png, .jpg or .html (a picture, a viewer).

        Raises:
            BeamboxError: for another ending.
        """
        return conversions.save_frame(self, Path(path))
