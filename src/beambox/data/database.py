"""Labelled objects cut out of their sweeps, to be placed into others (SECOND, section 3.2: ground-truth sampling)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beambox.checks import BeamboxError, did_you_mean, expect_same_length
from beambox.data.bev_overlap import bev_overlap
from beambox.data.formats.arrays import load_archive
from beambox.data.formats.columns import decode
from beambox.data.sampling import shuffled_indices
from beambox.data.source import FrameSource
from beambox.io import replacing
from beambox.ops.points_in_boxes import points_in_boxes_mask

__all__ = ["ObjectDatabase"]

FORMAT = "beambox objects 1"
ARRAYS = (("boxes", "f", 2), ("points", "f", 2), ("offsets", "iu", 1), ("labels", "iu", 1), ("classes", "U", 1),
          ("frames", "U", 1))  # fmt: skip
"""Name, kinds of numbers and dimensions of what a file holds."""
OBJECTS = 2  # stream of random numbers; those of the loader are 0 and 1


@dataclass(frozen=True)
class ObjectDatabase:
    """Objects with their points, one after the other."""

    boxes: np.ndarray
    """``(K, 7)`` float32 boxes where the objects stood, LiDAR frame."""
    points: np.ndarray
    """``(P, C)`` float32 points of all objects, x, y, z relative to their box's centre (not turned)."""
    offsets: np.ndarray
    """``(K + 1,)`` int64: object k owns rows ``offsets[k]`` to ``offsets[k + 1]``."""
    labels: np.ndarray
    """``(K,)`` int64 position in ``classes``."""
    classes: tuple[str, ...]
    """Names of the classes."""
    frames: tuple[str, ...]
    """``(K,)`` name of the frame each object was cut from."""

    def __post_init__(self) -> None:
        expect_same_length(boxes=len(self.boxes), labels=len(self.labels), frames=len(self.frames))
        expect_same_length(offsets=len(self.offsets), objects_plus_one=len(self.boxes) + 1)
        members = tuple(np.flatnonzero(self.labels == k) for k in range(len(self.classes)))
        object.__setattr__(self, "_members", members)

    def __len__(self) -> int:
        return len(self.boxes)

    def counts(self) -> dict[str, int]:
        """Number of objects of each class."""
        return {name: int((self.labels == k).sum()) for k, name in enumerate(self.classes)}

    @classmethod
    def build(
        cls,
        source: FrameSource,
        classes: Sequence[str],
        min_points: int = 5,
        drop_unknown_difficulty: bool = True,
        progress: Callable[[int, int], None] | None = None,
    ) -> ObjectDatabase:
        """Cut the objects out of every frame.

        Args:
            source: labelled frames with their whole sweeps: do not crop them to the camera's view.
            classes: names to keep.
            min_points: objects with fewer points are left out.
            drop_unknown_difficulty: leave out objects beyond KITTI's level "hard", where labels tell.
            progress: called with (frames done, frames in all).

        Raises:
            BeamboxError: if a frame has no labels, or frames differ in their point columns.
        """
        boxes, chunks, labels, frames = [], [], [], []
        columns = 4
        for number in range(len(source)):
            frame = source[number]
            if frame.labels is None:
                raise BeamboxError(f"an object database needs labelled frames, but {frame.id or number} has no labels")
            if chunks and frame.points.shape[1] != columns:
                raise BeamboxError(
                    f"all frames need the same point columns: {frame.id} has {frame.points.shape[1]}, others {columns}"
                )
            columns = frame.points.shape[1]
            keep = frame.labels.class_index(classes)
            if drop_unknown_difficulty and frame.labels.attributes is not None:
                keep[frame.labels.attributes.difficulty() < 0] = -1
            kept = frame.labels.boxes[keep >= 0]
            inside = points_in_boxes_mask(frame.points, kept).numpy()  # (M, N)
            for box, label, rows in zip(kept.numpy(), keep[keep >= 0].tolist(), inside):
                own = frame.points.numpy()[rows]
                if len(own) < max(1, min_points):
                    continue
                own[:, :3] -= box[:3]
                boxes.append(box)
                chunks.append(own)
                labels.append(label)
                frames.append(frame.id)
            if progress is not None:
                progress(number + 1, len(source))
        lengths = [len(own) for own in chunks]
        return cls(
            boxes=np.array(boxes, dtype=np.float32).reshape(-1, 7),
            points=np.concatenate(chunks) if chunks else np.zeros((0, columns), dtype=np.float32),
            offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
            labels=np.array(labels, dtype=np.int64),
            classes=tuple(classes),
            frames=tuple(frames),
        )

    def save(self, path: Path | str) -> None:
        """Write one .npz file."""
        with replacing(Path(path)) as stream:
            np.savez(
                stream,
                format=np.array(FORMAT),
                boxes=self.boxes,
                points=self.points,
                offsets=self.offsets,
                labels=self.labels,
                classes=np.array(self.classes, dtype=np.str_),
                frames=np.array(self.frames, dtype=np.str_),
            )

    @classmethod
    def load(cls, path: Path | str) -> ObjectDatabase:
        """Read a file that :meth:`save` wrote.

        Raises:
            BeamboxError: if it is another kind of file.
        """
        path = Path(path)

        def read() -> ObjectDatabase:
            file = load_archive(path, "object database")
            if "format" not in file or str(file["format"]) != FORMAT:
                raise BeamboxError(f"{path} is not an object database of this version; build it again")
            for name, kinds, dimensions in ARRAYS:
                array = file.get(name)
                if array is None or array.dtype.kind not in kinds or array.ndim != dimensions:
                    got = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
                    raise ValueError(f"expected {dimensions}-dimensional `{name}`, got {got}")
            boxes, points, offsets, labels, classes, frames = (file[name] for name, _, _ in ARRAYS)
            _check_arrays(boxes, points, offsets, labels, len(classes))
            return cls(
                boxes.astype(np.float32),
                points.astype(np.float32),
                offsets.astype(np.int64),
                labels.astype(np.int64),
                classes=tuple(map(str, classes.tolist())),
                frames=tuple(map(str, frames.tolist())),
            )

        return decode(path, "object database", read)

    @classmethod
    def joined(cls, databases: Sequence[ObjectDatabase]) -> ObjectDatabase:
        """Join the objects of several databases, such as simulated and real ones; columns must agree."""
        columns = {database.points.shape[1] for database in databases}
        if len(columns) != 1:
            raise BeamboxError(f"databases to join need the same point columns, got {sorted(columns) or 'none'}")
        classes = tuple(dict.fromkeys(name for database in databases for name in database.classes))
        lengths = np.concatenate([np.diff(database.offsets) for database in databases])
        return cls(
            boxes=np.concatenate([database.boxes for database in databases]),
            points=np.concatenate([database.points for database in databases]),
            offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
            labels=np.concatenate(
                [np.array([classes.index(c) for c in db.classes], dtype=np.int64)[db.labels] for db in databases]
            ),
            classes=classes,
            frames=tuple(name for database in databases for name in database.frames),
        )

    def draw(self, name: str, count: int, draw_index: int, seed: int, needed: int | None = None) -> np.ndarray:
        """Return the objects that the ``draw_index``-th draw of ``count`` takes: a shuffled walk, each once per pass.

        Args:
            name: class to draw from.
            count: how many; fewer come where the class has fewer.
            draw_index: number of the draw, 0 for the first of a run; a pure function of it and the seed.
            seed: names the walk.
            needed: take only the first so many of them and pass over the others.

        Returns:
            ``(count or fewer,)`` int64 numbers of objects.
        """
        if name not in self.classes:
            raise BeamboxError(f'the object database has no class "{name}"{did_you_mean(name, self.classes)}')
        kind = self.classes.index(name)
        members = self._members[kind]  # type: ignore[attr-defined]
        count = min(count, len(members))
        if count == 0:
            return np.zeros(0, dtype=np.int64)
        steps = shuffled_indices(len(members), draw_index * count, count, (seed, OBJECTS, kind))
        return np.unique(members[steps[:needed]])

    def sample(
        self,
        existing: np.ndarray,
        wanted: Sequence[tuple[str, int]],
        draw_index: int,
        seed: int,
        present: Mapping[str, int] | None = None,
    ) -> tuple[np.ndarray, list[str]]:
        """Draw objects that stand free: classes in turn, colliding candidates left out (both, where two collide).

        Args:
            existing: ``(N, 7)`` boxes already in the frame.
            wanted: (class, count) in the order of drawing.
            draw_index: number of the draw; see :meth:`draw`.
            seed: names the walk.
            present: by class, how many of the count need not be drawn; none where a class is missing.

        Returns:
            ``(K,)`` int64 numbers of the accepted objects and their class names.
        """
        taken: list[np.ndarray] = []
        names: list[str] = []
        for name, count in wanted:
            drawn = self.draw(name, count, draw_index, seed, max(0, count - (present or {}).get(name, 0)))
            candidates = self.boxes[drawn]  # (n, 7)
            among = bev_overlap(candidates[:, None], candidates)  # (n, n)
            np.fill_diagonal(among, False)
            free = ~(among.any(axis=1) | bev_overlap(candidates[:, None], existing).any(axis=1))
            taken.append(drawn[free])
            names += [name] * int(free.sum())
            existing = np.concatenate((existing, candidates[free]))
        return np.concatenate(taken) if taken else np.zeros(0, dtype=np.int64), names

    def points_of(self, objects: np.ndarray, centers: np.ndarray) -> np.ndarray:
        """Return the points of some objects, carried to given centres: ``(K,)``, ``(K, 3)`` -> ``(P, C)`` float32."""
        first = self.offsets[objects]
        lengths = self.offsets[objects + 1] - first
        ends = np.cumsum(lengths)
        total = int(ends[-1]) if len(ends) else 0
        rows = np.repeat(first - (ends - lengths), lengths) + np.arange(total)
        points = self.points[rows]  # a copy: advanced indexing
        points[:, :3] += np.repeat(centers.astype(np.float32), lengths, axis=0)
        return points


def _check_arrays(boxes: np.ndarray, points: np.ndarray, offsets: np.ndarray, labels: np.ndarray, classes: int) -> None:
    """Refuse arrays that do not fit each other; an object's rows would else be those of another, or of none.

    Raises:
        ValueError: naming what does not fit.
    """
    if boxes.shape[1] != 7 or points.shape[1] < 4:
        raise ValueError(f"expected boxes (K, 7) and points (P, 4 or more), got {boxes.shape} and {points.shape}")
    if not np.isfinite(boxes).all() or not np.isfinite(points).all() or (len(boxes) and boxes[:, 3:6].min() < 0):
        raise ValueError("expected finite numbers and sizes of at least 0")
    counted = offsets.astype(np.int64)
    if len(counted) != len(boxes) + 1 or counted[0] != 0 or counted[-1] != len(points) or (np.diff(counted) < 0).any():
        raise ValueError("`offsets` must lead from 0 to the number of points")
    if len(labels) != len(boxes) or (len(labels) and not 0 <= int(labels.min()) <= int(labels.max()) < classes):
        raise ValueError(f"`labels` must be one for each box, in 0 to {classes - 1}")
