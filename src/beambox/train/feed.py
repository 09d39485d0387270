"""The stream of training batches: which frames, changed how, seen through which window; a pure function of the step."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from beambox.checks import BeamboxError
from beambox.data.source import FrameSource
from beambox.geometry.grid import VoxelGrid
from beambox.structures import Batch, Frame, Labels

__all__ = ["Draws", "Feed", "TrainingBatch", "choose_window", "stream"]

# what a random stream is for; keeps the streams of one seed apart
ORDER, CHANGES, WINDOW = 1, 2, 3
ATTEMPTS = 8


@dataclass(frozen=True)
class Draws:
    """The order in which frames are drawn from several sources.

    Without weights an epoch shows every frame once. With weights it is as long but source s has the share
    weights[s] / sum of it, and goes through all of its frames before any comes again.
    """

    sizes: tuple[int, ...]
    """Number of frames of each source."""
    weights: tuple[float, ...] | None
    """Relative share of each source."""
    seed: int

    def __post_init__(self) -> None:
        if not self.sizes or min(self.sizes) <= 0:
            raise BeamboxError(f"every source of training frames must have some; got sizes {list(self.sizes)}")

    @property
    def epoch_size(self) -> int:
        """Number of frames drawn in an epoch."""
        return sum(self.sizes)

    def epoch(self, number: int) -> np.ndarray:
        """Return ``(epoch_size, 2)`` int64: source and frame of each draw of an epoch."""
        shares = self.sizes if self.weights is None else self.weights
        ends = np.round(np.cumsum(shares) / np.sum(shares) * self.epoch_size).astype(np.int64)
        quotas = np.diff(ends, prepend=0)
        drawn = [
            np.stack((np.full(quota, source), self._walk(source, number * int(quota), int(quota))), axis=1)
            for source, quota in enumerate(quotas)
        ]
        rows = np.concatenate(drawn)
        return rows[np.random.default_rng((self.seed, ORDER, number)).permutation(len(rows))]

    def _walk(self, source: int, first: int, count: int) -> np.ndarray:
        """Frames first to first + count of an endless walk through a source, shuffled anew on each pass."""
        size = self.sizes[source]
        passes = range(first // size, (first + count - 1) // size + 1) if count else range(0)
        orders = [np.random.default_rng((self.seed, ORDER, n, source)).permutation(size) for n in passes]
        walk = np.concatenate(orders) if orders else np.zeros(0, dtype=np.int64)
        start = first - passes.start * size
        return walk[start : start + count]


class TrainingBatch:
    """What one process needs for one step; a plain object, which Fabric and DDP pass on without looking into it."""

    def __init__(self, batch: Batch, grid: VoxelGrid | None) -> None:
        self.batch = batch
        """Frames of this process, with labels."""
        self.grid = grid
        """The window to look at; None for the detector's whole grid."""

    def to(self, device: torch.device | str) -> TrainingBatch:
        """Move the points to a device."""
        return TrainingBatch(self.batch.to(device), self.grid)


def choose_window(
    labels: Sequence[Labels], classes: Sequence[str], grid: VoxelGrid, cells: tuple[int, int], rng: np.random.Generator
) -> VoxelGrid:
    """Choose a window of the grid that holds the centre of a random object (anywhere, where there is none).

    The window starts at a multiple of 8 cells, so that it meets the strides of the networks; where it is as large as
    the grid or larger, it is the grid.
    """
    size = grid.size[:2]
    cells = (min(cells[0], size[0]), min(cells[1], size[1]))
    boxes = torch.cat([one.of_classes(classes).boxes for one in labels])
    boxes = boxes[grid.contains(boxes)]
    first = []
    index = grid.index(boxes)[0].flip(1).numpy() if len(boxes) else None  # (N, 3) x, y, z
    chosen = None if index is None else index[rng.integers(len(index))]
    for axis in (0, 1):
        low, high = 0, size[axis] - cells[axis]
        if chosen is not None:
            low = max(low, int(chosen[axis]) - cells[axis] + 1)
            high = min(high, int(chosen[axis]))
        starts = [start for start in range(0, size[axis] - cells[axis] + 1, 8) if low <= start <= high]
        first.append(int(rng.choice(starts)) if starts else min(max(low, 0), high) // 8 * 8)
    return grid.window((first[0], first[1]), cells)


class Feed(Dataset[TrainingBatch]):
    """Training batches by step number."""

    def __init__(
        self,
        sources: Sequence[FrameSource],
        draws: Draws,
        change: Callable[[Frame, np.random.Generator], Frame],
        classes: Sequence[str],
        grid: VoxelGrid,
        batch: int,
        window: tuple[int, int] | None = None,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        """Args: see the fields of a recipe; ``change`` augments a frame, ``batch`` counts all ``world`` processes."""
        if batch % world:
            raise BeamboxError(f"optim.batch = {batch} frames cannot be shared evenly by {world} processes")
        self.sources, self.draws, self.change = list(sources), draws, change
        self.classes, self.grid, self.window = tuple(classes), grid, window
        self.batch, self.rank, self.world = batch, rank, world
        self._epoch: tuple[int, np.ndarray] = (-1, np.zeros((0, 2), dtype=np.int64))

    def __getitem__(self, step: int) -> TrainingBatch:
        """Return this process's share of the batch of a step."""
        share = self.batch // self.world
        first = step * self.batch + self.rank * share
        frames = [self.frame(first + i) for i in range(share)]
        batch = Batch.of(frames)
        assert batch.labels is not None
        if self.window is None:
            return TrainingBatch(batch, None)
        rng = np.random.default_rng((self.draws.seed, WINDOW, step, self.rank))
        grid = choose_window(batch.labels, self.classes, self.grid, self.window, rng)
        frames = [crop(frame, grid) for frame in frames]
        return TrainingBatch(Batch.of(frames), grid)

    def frame(self, position: int) -> Frame:
        """Return the frame at a position of the run, augmented; one left without objects is replaced by another."""
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng((self.draws.seed, CHANGES, position, attempt))
            source, index = self._draw(position) if attempt == 0 else self._any(rng)
            frame = self.change(self.sources[source][index], rng)
            if frame.labels is None:
                raise BeamboxError(f"frame {frame.id} has no labels, training needs them")
            labels = frame.labels.of_classes(self.classes)
            if bool(self.grid.contains(labels.boxes).any()):
                break
        return frame

    def _draw(self, position: int) -> tuple[int, int]:
        number, place = divmod(position, self.draws.epoch_size)
        if self._epoch[0] != number:
            self._epoch = (number, self.draws.epoch(number))
        source, index = self._epoch[1][place]
        return int(source), int(index)

    def _any(self, rng: np.random.Generator) -> tuple[int, int]:
        source = int(rng.integers(len(self.sources)))
        return source, int(rng.integers(len(self.sources[source])))


def crop(frame: Frame, grid: VoxelGrid) -> Frame:
    """Keep the points of a window, in order: fewer to send and to sort."""
    x, y = frame.points[:, 0], frame.points[:, 1]
    (x0, y0, _), (x1, y1, _) = grid.minimum, grid.maximum
    return frame.with_points(frame.points[(x >= x0) & (x < x1) & (y >= y0) & (y < y1)])


def stream(feed: Feed, start: int, end: int, workers: int) -> Iterator[TrainingBatch]:
    """Yield the batches of steps ``start`` to ``end`` - 1, prepared by ``workers`` background processes."""
    loader = DataLoader(
        feed,
        batch_size=None,
        sampler=range(start, end),
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_quiet_worker if workers else None,
    )
    return iter(loader)


def _quiet_worker(_: int) -> None:
    """Leave Ctrl-C to the training process, which ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
