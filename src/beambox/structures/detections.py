"""What a detector found in one frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, cast, overload

import torch
from torch import Tensor

from beambox import __version__
from beambox.checks import BeamboxError, did_you_mean, expect_same_length, expect_shape, printable
from beambox.file_names import name_to_word
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

__all__ = ["Detection", "Detections"]

COLUMNS = ("frame", "name", "score", *rows.BOX)


@dataclass(frozen=True)
class Detection:
    """One detection: what ``detections[0]`` and a loop over detections give."""

    name: str
    """Class."""
    score: float
    """Confidence in [0, 1]."""
    box: tuple[float, ...]
    """x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""
    class_id: int = 0
    """Position of the class in the ``classes`` of the detections."""
    frame_id: str = ""
    """Name of the frame."""


@dataclass(frozen=True, eq=False, repr=False)
class Detections:
    """Boxes with scores and classes, best first as detectors return them; behaves like a sequence.

    Arrays and lists are accepted wherever a tensor is expected.
    """

    boxes: Tensor
    """``(N, 7)`` x, y, z, l, w, h, yaw in the LiDAR frame; metres, radians."""
    scores: Tensor
    """``(N,)`` confidence in [0, 1]."""
    class_ids: Tensor
    """``(N,)`` int64 position of the class in ``classes``."""
    classes: tuple[str, ...]
    """Names of the detector's classes."""
    frame_id: str = ""
    """Name of the frame."""

    if TYPE_CHECKING:  # what may be passed; the fields hold tensors

        def __init__(
            self,
            boxes: Tensor | ArrayLike,
            scores: Tensor | ArrayLike,
            class_ids: Tensor | ArrayLike,
            classes: Sequence[str],
            frame_id: str = "",
        ) -> None: ...

    def __post_init__(self) -> None:
        boxes = as_numbers("boxes", self.boxes, torch.float32)
        object.__setattr__(self, "boxes", boxes.reshape(0, 7) if not boxes.numel() and boxes.dim() < 2 else boxes)
        object.__setattr__(self, "scores", as_numbers("scores", self.scores, torch.float32))
        object.__setattr__(self, "class_ids", as_numbers("class_ids", self.class_ids, torch.int64))
        if isinstance(self.classes, str):
            raise BeamboxError(f'`classes` must be a sequence of names, got the text "{self.classes}"')
        object.__setattr__(self, "classes", tuple(self.classes))
        expect_shape("boxes", self.boxes, ("N", 7))
        expect_shape("scores", self.scores, ("N",))
        expect_shape("class_ids", self.class_ids, ("N",))
        expect_same_length(boxes=len(self.boxes), scores=len(self.scores), class_ids=len(self.class_ids))
        ids = self.class_ids
        if ids.device.type != "cpu":  # a GPU would have to be waited for; they are checked when brought home
            return
        if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < len(self.classes):
            raise BeamboxError(
                f"`class_ids` must lie in 0 to {len(self.classes) - 1}, the positions in `classes`, "
                f"got {int(ids.min())} to {int(ids.max())}"
            )

    # --- as a sequence ------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.scores)

    @overload
    def __getitem__(self, index: Index) -> Detections: ...  # pyright: ignore[reportOverlappingOverload]
    @overload
    def __getitem__(self, index: SupportsIndex) -> Detection: ...
    def __getitem__(self, index: SupportsIndex | Index) -> Detection | Detections:
        """Select: a number gives one :class:`Detection`; a slice, a mask or positions give detections."""
        chosen = positions(index, len(self))
        if isinstance(chosen, Tensor):
            at = chosen.to(self.scores.device)
            return replace(self, boxes=self.boxes[at], scores=self.scores[at], class_ids=self.class_ids[at])
        kind = int(self.class_ids[chosen])
        box = tuple(floats(self.boxes[chosen]))
        return Detection(self.classes[kind], float(self.scores[chosen]), box, kind, self.frame_id)

    def __iter__(self) -> Iterator[Detection]:
        """Yield each :class:`Detection`, in order."""
        boxes, scores = rows_of(self.boxes), floats(self.scores)
        for box, score, kind in zip(boxes, scores, integers(self.class_ids)):
            yield Detection(self.classes[kind], score, tuple(box), kind, self.frame_id)

    def __eq__(self, other: object) -> bool:
        """Whether every field is equal, tensors value by value, wherever they lie."""
        if not isinstance(other, Detections):
            return NotImplemented
        return same_fields(self, other)

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # tensors can be changed in place

    def __repr__(self) -> str:
        best = f"; best {float(self.scores.max()):.2f}" if len(self) else ""
        frame = f"; frame {printable(self.frame_id[:60])}" if self.frame_id else ""
        return f"Detections({len(self)}: {rows.counted(self.names)}{best}{frame})"

    def _repr_html_(self) -> str:
        """Show a bird's-eye view in a notebook."""
        return conversions.html_of(repr(self), self.plot())

    # --- what is known ------------------------------------------------------------------------------------------------

    @property
    def names(self) -> list[str]:
        """Class name of each detection."""
        return [self.classes[i] for i in integers(self.class_ids)]

    @property
    def corners(self) -> Tensor:
        """``(N, 8, 3)`` corners of the boxes, metres; ordered as :func:`beambox.geometry.corners_3d` says."""
        return corners_3d(self.boxes)

    @property
    def distances(self) -> Tensor:
        """``(N,)`` metres from the origin of the LiDAR frame to the centers of the boxes, in 3-D (as ONCE's bands)."""
        return self.boxes[:, :3].square().sum(dim=1).sqrt()

    # --- selections and copies ----------------------------------------------------------------------------------------

    def of_classes(self, classes: str | Sequence[str]) -> Detections:
        """Keep the detections of one class or several.

        Raises:
            BeamboxError: for a name that is none of ``classes``.
        """
        wanted = [classes] if isinstance(classes, str) else list(classes)
        for name in wanted:
            if self.classes and name not in self.classes:
                raise BeamboxError(f'these detections know no class "{name}"{did_you_mean(name, self.classes)}')
        return self[torch.tensor([name in wanted for name in self.names], dtype=torch.bool)]

    def above(self, score: float) -> Detections:
        """Keep the detections whose score is at least ``score``."""
        return self[self.scores >= score]

    def with_boxes(self, boxes: Tensor | ArrayLike) -> Detections:
        """Return the same detections with other boxes, ``(N, 7)``."""
        return replace(self, boxes=boxes)  # pyright: ignore[reportArgumentType]  # turned into a tensor at birth

    def to(self, device: torch.device | str) -> Detections:
        """Move to a device."""
        moved = (self.boxes.to(device), self.scores.to(device), self.class_ids.to(device))
        return Detections(*moved, self.classes, self.frame_id)

    @classmethod
    def empty(cls, classes: Sequence[str] = (), frame_id: str = "") -> Detections:
        """No detections."""
        return cls(torch.zeros(0, 7), torch.zeros(0), torch.zeros(0, dtype=torch.int64), tuple(classes), frame_id)

    @classmethod
    def merge(cls, parts: Sequence[Detections]) -> Detections:
        """Join detections of one frame, of several detectors say; best first, nothing suppressed.

        Classes are joined by name, in the order in which they first occur. The name of the frame is kept where all
        parts have the same.
        """
        classes = tuple(dict.fromkeys(name for part in parts for name in part.classes))
        if not parts:
            return cls.empty()
        scores = torch.cat([part.scores for part in parts])
        ids = [
            torch.tensor([classes.index(name) for name in part.classes], device=part.scores.device)[part.class_ids]
            if len(part) else part.class_ids
            for part in parts
        ]  # fmt: skip
        frames = {part.frame_id for part in parts}
        joined = cls(
            torch.cat([part.boxes for part in parts]), scores, torch.cat(ids), classes,
            frames.pop() if len(frames) == 1 else "",
        )  # fmt: skip
        return joined[scores.argsort(descending=True, stable=True)]

    # --- to and from other forms --------------------------------------------------------------------------------------

    def to_rows(self) -> list[dict[str, float | str]]:
        """Return one flat record per detection, in the LiDAR frame, for JSON and CSV."""
        return [
            {"frame": one.frame_id, "name": one.name, "score": one.score, **dict(zip(rows.BOX, one.box))}
            for one in self
        ]

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Return arrays: ``boxes`` (N, 7), ``scores`` (N,), ``class_ids`` (N,) and ``names`` (N,)."""
        import numpy as np

        return {
            "boxes": self.boxes.detach().cpu().float().numpy(),
            "scores": self.scores.detach().cpu().float().numpy(),
            "class_ids": self.class_ids.cpu().numpy(),
            "names": np.array(self.names, dtype=str),
        }

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with the columns frame, name, score, x, y, z, l, w, h, yaw (needs pandas)."""
        return rows.frame_of_rows(self.to_rows(), COLUMNS)

    def to_json(self, model: str = "") -> str:
        """Write JSON: the frame, the classes, the version, and one object per detection; metres and radians.

        Args:
            model: name of the weights, kept in the text.
        """
        head = {"frame": self.frame_id, "model": model, "beambox": __version__, "classes": list(self.classes)}
        objects = [{key: row[key] for key in COLUMNS[1:]} for row in rows.rounded(self.to_rows())]
        return rows.json_text(objects, head, "detections")

    @classmethod
    def from_json(cls, text: str, where: str = "the text") -> Detections:
        """Read what :meth:`to_json` wrote; ``where`` is what errors call it."""
        content, found = rows.parse_json(text, where, "detections", COLUMNS[1:])
        given = content.get("classes")
        listed = cast("list[object]", given) if isinstance(given, list) else []
        classes = [name for name in listed if isinstance(name, str)]
        if not isinstance(given, list) or len(classes) < len(listed):
            raise BeamboxError(f'{where} must have the names of the classes under "classes", got {given!r:.80}')
        return _from_rows(found, classes, str(content.get("frame", "")), where)

    def to_csv(self) -> str:
        """Write CSV with a header line: frame, name, score, x, y, z, l, w, h, yaw."""
        return rows.csv_text(rows.rounded(self.to_rows()), COLUMNS)

    @classmethod
    def from_csv(cls, text: str, where: str = "the text", frame_id: str = "") -> Detections:
        """Read what :meth:`to_csv` wrote; the classes are those that occur."""
        found = rows.parse_csv(text, where, COLUMNS[1:])
        return _from_rows(found, list(dict.fromkeys(row["name"] for row in found)), frame_id, where)

    def to_kitti(self, calibration: Calibration, image_size: tuple[int, int] | None = None) -> str:
        """Write KITTI's result lines, one per detection, in order.

        Args:
            calibration: of the frame; KITTI's boxes live in its camera.
            image_size: (width, height) to clip the image boxes to; None leaves them unclipped.

        Returns:
            Text, every line ended by a newline; empty where nothing was found.
        """
        camera = calibration.to_camera(self.boxes.cpu(), image_size)
        columns = torch.cat(
            (
                camera.alpha[:, None],
                camera.image,
                camera.size,
                camera.location,
                camera.rotation_y[:, None],
                self.scores.detach().cpu().double()[:, None],
            ),
            dim=1,
        )  # (N, 13)
        lines = (
            f"{name_to_word(name)} -1 -1 " + " ".join(f"{value:.4f}" for value in row) + "\n"
            for name, row in zip(self.names, rows_of(columns))
        )
        return "".join(lines)

    @classmethod
    def from_kitti(
        cls, text: str, calibration: Calibration, classes: Sequence[str] | None = None, frame_id: str = ""
    ) -> Detections:
        """Read KITTI's result lines; classes are those that occur, sorted, where none are given."""
        return conversions.detections_from_kitti(text, calibration, classes, frame_id)

    def to_supervision(self, calibration: Calibration, image_size: tuple[int, int] | None = None) -> Any:
        """Return the boxes in the camera image as ``supervision.Detections``; those behind the camera are left out.

        ``data`` holds ``class_name`` and ``box3d``, the ``(N, 7)`` boxes.

        Raises:
            BeamboxError: if supervision is not installed.
        """
        return conversions.to_supervision(self, calibration, image_size)

    def plot(self, frame: Frame | None = None, **options: Any) -> Image:
        """Draw a bird's-eye view, over the points of ``frame`` where given; see :func:`beambox.draw`."""
        return conversions.plot(frame, self, None, **options)

    def save(
        self, path: str | Path, *, frame: Frame | None = None, calibration: Calibration | None = None, model: str = ""
    ) -> Path:
        """Write a file; its ending says what: .json, .csv, .txt (KITTI), .png, .jpg or .html (a picture, a viewer).

        Args:
            path: where to; folders are made.
            frame: points below the picture, and the calibration for KITTI's format.
            calibration: for KITTI's format, where the frame has none.
            model: name of the weights, kept in JSON.

        Raises:
            BeamboxError: for another ending, or KITTI's format without a calibration.
        """
        return conversions.save_detections(self, Path(path), frame, calibration, model)


def _from_rows(found: Sequence[dict[str, Any]], classes: Sequence[str], frame_id: str, where: str) -> Detections:
    for row in found:
        if row["name"] not in classes:
            raise BeamboxError(f'{where}: unknown class "{row["name"]}"{did_you_mean(row["name"], classes)}')
    boxes = torch.tensor([[row[key] for key in rows.BOX] for row in found], dtype=torch.float32).reshape(-1, 7)
    scores = torch.tensor([row["score"] for row in found], dtype=torch.float32)
    ids = torch.tensor([list(classes).index(row["name"]) for row in found], dtype=torch.int64)
    return Detections(boxes, scores, ids, classes, frame_id)
