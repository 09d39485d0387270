"""Batches of frames in a seeded order.

The order of an epoch is a pure function of (seed, epoch), and what augmentation does to the frame at one position of it
a pure function of (seed, epoch, position). Neither depends on the number of workers or on what was loaded before, so a
run that resumes continues as if it had not stopped, and ranks that share an epoch see each frame once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from beambox.checks import BeamboxError, expect_same_length
from beambox.data.augment import AugmentConfig, augment
from beambox.data.database import ObjectDatabase
from beambox.data.source import FrameSource
from beambox.data.walk import walk
from beambox.geometry import VoxelGrid
from beambox.structures import Batch, Frame

__all__ = ["FrameLoader", "MixedSource", "epoch_order", "prepare_frame"]

ORDER, AUGMENT = 0, 1  # streams of random numbers that must not meet; the object database has 2
REPLACEMENTS = 10
Key = tuple[int, int, int]  # epoch, position in its order, number of the frame


@dataclass(frozen=True)
class MixedSource:
    """Several sources as one, with a share of every epoch each."""

    sources: Sequence[FrameSource]
    """Where the frames come from."""
    weights: Sequence[float] | None = None
    """Share of each source in an epoch, in any unit; None takes every frame once."""
    epoch_length: int | None = None
    """Frames an epoch; None takes as many as there are."""

    def __post_init__(self) -> None:
        if not self.sources:
            raise BeamboxError("a mixture needs at least one source, got none")
        if self.weights is not None:
            expect_same_length(weights=len(self.weights), sources=len(self.sources))
            if min(self.weights) < 0 or sum(self.weights) <= 0:
                raise BeamboxError(f"`weights` must be at least 0 and not all 0, got {list(self.weights)}")

    @property
    def ids(self) -> list[str]:
        """Names of the frames, with the number of the source before them so that they stay unique."""
        return [f"{k}:{name}" for k, source in enumerate(self.sources) for name in source.ids]

    def __len__(self) -> int:
        return sum(len(source) for source in self.sources)

    def __getitem__(self, index: int) -> Frame:
        for source in self.sources:
            if index < len(source):
                return source[index]
            index -= len(source)
        raise IndexError(index)

    def order(self, seed: int, epoch: int) -> np.ndarray:
        """Return the frames of an epoch, shuffled; each source is walked through, so none repeats before all came."""
        sizes = np.array([len(source) for source in self.sources])
        weights = sizes if self.weights is None else np.array(self.weights)
        length = self.epoch_length or int(sizes.sum())
        ends = np.round(np.cumsum(weights) / weights.sum() * length).astype(np.int64)
        counts = np.diff(ends, prepend=0)
        first = np.cumsum(sizes) - sizes
        parts = [
            first[k] + walk(int(sizes[k]), epoch * count, count, (seed, ORDER, k))
            for k, count in enumerate(counts.tolist())
            if count
        ]
        return np.random.default_rng((seed, ORDER, epoch)).permutation(np.concatenate(parts))


def epoch_order(source: FrameSource, seed: int, epoch: int, shuffle: bool = True) -> np.ndarray:
    """Return the numbers of the frames of an epoch in order: a pure function of its arguments."""
    if not shuffle:
        return np.arange(len(source))
    if isinstance(source, MixedSource):
        return source.order(seed, epoch)
    return np.random.default_rng((seed, ORDER, epoch)).permutation(len(source))


def prepare_frame(frame: Frame, classes: Sequence[str] | None, grid: VoxelGrid | None) -> Frame:
    """Drop what a detector cannot use: objects of other classes or centred outside its region, points outside it."""
    labels = frame.labels
    if labels is not None and classes is not None:
        labels = labels.of_classes(classes)
    if labels is not None and grid is not None:
        labels = labels[grid.contains(labels.boxes[:, :3])]
    points = frame.points
    if grid is not None:
        cloud = points.numpy()
        (x0, y0, z0), (x1, y1, z1) = grid.minimum, grid.maximum
        x, y, z = cloud[:, 0], cloud[:, 1], cloud[:, 2]
        # closed, and so a hair wider than the grid's own test, which decides
        inside = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (z >= z0) & (z <= z1)
        points = torch.from_numpy(cloud[inside])
    return replace(frame, points=points, labels=labels)


class FrameLoader:
    """Batches of a source; every epoch is an iterator of its own.

    Example::

        loader = FrameLoader(source, batch_size=4, seed=0, augmentation=AugmentConfig(), database=database)
        for epoch in range(80):
            for batch in loader.epoch(epoch):
                ...
    """

    def __init__(
        self,
        source: FrameSource,
        batch_size: int = 1,
        *,
        seed: int = 0,
        shuffle: bool = True,
        drop_last: bool | None = None,
        augmentation: AugmentConfig | None = None,
        database: ObjectDatabase | None = None,
        classes: Sequence[str] | None = None,
        grid: VoxelGrid | None = None,
        workers: int = 0,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        """Set up; nothing is read yet.

        Args:
            source: the frames; must be picklable where ``workers`` > 0, since workers are spawned.
            batch_size: frames a batch on this rank.
            seed: of the order and of augmentation.
            shuffle: another order every epoch; otherwise the source's.
            drop_last: leave out the frames that fill no whole batch on every rank; None does so where ``shuffle``.
            augmentation: what to do to every frame; None leaves them as they are.
            database: objects for ``augmentation.sample``.
            classes: keep only objects of these classes, after augmentation (others still keep sampled objects away).
            grid: drop points outside it and objects centred outside it.
            workers: processes that read and augment; 0 does it here.
            rank: number of this process among ``world``.
            world: processes that share the epoch.

        With augmentation, a frame that ends without an object is replaced by another, drawn at random.
        """
        if batch_size < 1 or not 0 <= rank < world or workers < 0 or seed < 0:
            raise BeamboxError(
                "expected batch_size >= 1, 0 <= rank < world, workers >= 0 and seed >= 0, "
                f"got {batch_size}, rank {rank} of {world}, {workers} and {seed}"
            )
        if len(source) == 0:
            raise BeamboxError("a loader needs at least one frame, but the source is empty")
        self.source = source
        self._batches = _BatchOrder(source, batch_size, seed, shuffle, drop_last, rank, world)
        frames = _PreparedFrames(source, seed, augmentation, database, classes, grid)
        self._loader = DataLoader(
            frames,
            batch_sampler=self._batches,
            collate_fn=Batch.of,
            num_workers=workers,
            persistent_workers=workers > 0,
            multiprocessing_context="spawn" if workers else None,
        )

    def __len__(self) -> int:
        """Batches an epoch, on this rank."""
        return self._batches.total()

    def epoch(self, epoch: int, start: int = 0) -> Iterator[Batch]:
        """Yield the batches of an epoch.

        Args:
            epoch: number of the epoch, from 0.
            start: number of the first batch, to resume within an epoch.
        """
        self._batches.number, self._batches.start = epoch, start
        yield from self._loader


class _BatchOrder(Sampler[list[Key]]):
    """Which frames make up which batch."""

    def __init__(
        self,
        source: FrameSource,
        batch_size: int,
        seed: int,
        shuffle: bool,
        drop_last: bool | None,
        rank: int,
        world: int,
    ) -> None:
        self.source, self.batch_size, self.seed, self.shuffle = source, batch_size, seed, shuffle
        self.rank, self.world = rank, world
        length = len(epoch_order(source, seed, 0, shuffle))
        self.drop_last = (shuffle if drop_last is None else drop_last) and length >= batch_size * world
        self.number = self.start = 0

    def total(self) -> int:
        return len(self._keys(0))

    def __len__(self) -> int:
        return max(0, self.total() - self.start)

    def __iter__(self) -> Iterator[list[Key]]:
        yield from self._keys(self.number)[self.start :]

    def _keys(self, epoch: int) -> list[list[Key]]:
        order = epoch_order(self.source, self.seed, epoch, self.shuffle).tolist()
        together = self.batch_size * self.world
        if self.drop_last:
            order = order[: len(order) // together * together]
        mine = [(epoch, position, index) for position, index in enumerate(order)][self.rank :: self.world]
        return [mine[k : k + self.batch_size] for k in range(0, len(mine), self.batch_size)]


class _PreparedFrames(Dataset[Frame]):
    """Frames, read, augmented and cropped; indexed by (epoch, position, number of the frame)."""

    def __init__(
        self,
        source: FrameSource,
        seed: int,
        augmentation: AugmentConfig | None,
        database: ObjectDatabase | None,
        classes: Sequence[str] | None,
        grid: VoxelGrid | None,
    ) -> None:
        self.source, self.seed, self.augmentation, self.database = source, seed, augmentation, database
        self.classes = None if classes is None else tuple(classes)
        self.grid = grid
        self.epoch_length = len(epoch_order(source, seed, 0))

    def __getitem__(self, key: Key) -> Frame:
        epoch, position, index = key
        if self.augmentation is None:
            return prepare_frame(self.source[index], self.classes, self.grid)
        rng = np.random.default_rng((self.seed, AUGMENT, epoch, position))
        turn = epoch * self.epoch_length + position
        frame = self._augmented(index, rng, turn)
        for _ in range(REPLACEMENTS):
            if frame.labels is None or len(frame.labels):
                break
            frame = self._augmented(int(rng.integers(len(self.source))), rng, turn)
        return frame

    def _augmented(self, index: int, rng: np.random.Generator, turn: int) -> Frame:
        assert self.augmentation is not None
        changed = augment(self.source[index], rng, self.augmentation, self.database, turn, self.seed)
        return prepare_frame(changed, self.classes, self.grid)
