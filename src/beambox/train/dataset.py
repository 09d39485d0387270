"""The stream of training batches: which frames, changed how, seen through which window; a pure function of the step."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from beambox.checks import BeamboxError
from beambox.data.mixture import MixedSource
from beambox.geometry.grid import VoxelGrid
from beambox.structures import Batch, Frame, Labels

__all__ = ["TrainingBatch", "TrainingDataset", "choose_window", "make_loader"]

# what a random stream is for; keeps the streams of one seed apart, and apart from those of beambox.data
AUGMENT, WINDOW = 11, 12
ATTEMPTS = 8


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


class TrainingDataset(Dataset[TrainingBatch]):
    """Training batches by step number."""

    def __init__(
        self,
        source: MixedSource,
        augment: Callable[[Frame, np.random.Generator, int], Frame],
        classes: Sequence[str],
        grid: VoxelGrid,
        batch: int,
        window: tuple[int, int] | None = None,
        *,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        """Set up.

        Args:
            source: training frames.
            augment: augments a frame, given a generator and the frame's position in the run.
            classes: of the detector.
            grid: of the detector.
            batch: frames in a step, all processes together.
            window: cells (x, y) to look at; None for all.
            seed: of the order, the changes and the windows.
            rank: of this process.
            world: number of processes.
        """
        if batch % world:
            raise BeamboxError(f"optim.batch = {batch} frames cannot be shared evenly by {world} processes")
        if len(source) == 0:
            raise BeamboxError("there are no training frames")
        self.source, self.augment = source, augment
        self.classes, self.grid, self.window = tuple(classes), grid, window
        self.batch, self.seed, self.rank, self.world = batch, seed, rank, world
        self._order: tuple[int, np.ndarray] = (-1, np.zeros(0, dtype=np.int64))

    def __getitem__(self, step: int) -> TrainingBatch:
        """Return this process's share of the batch of a step."""
        share = self.batch // self.world
        first = step * self.batch + self.rank * share
        frames = [self.frame(first + i) for i in range(share)]
        batch = Batch.of(frames)
        assert batch.labels is not None
        if self.window is None:
            return TrainingBatch(batch, None)
        rng = np.random.default_rng((self.seed, WINDOW, step, self.rank))
        grid = choose_window(batch.labels, self.classes, self.grid, self.window, rng)
        frames = [crop(frame, grid) for frame in frames]
        return TrainingBatch(Batch.of(frames), grid)

    def frame(self, position: int) -> Frame:
        """Return the frame at a position of the run, augmented; one left without objects is replaced by another."""
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng((self.seed, AUGMENT, position, attempt))
            index = self._draw(position) if attempt == 0 else int(rng.integers(len(self.source)))
            frame = self.augment(self.source[index], rng, position)
            if frame.labels is None:
                raise BeamboxError(f"frame {frame.id} has no labels, training needs them")
            if bool(self.grid.contains(frame.labels.of_classes(self.classes).boxes).any()):
                break
        return frame

    def _draw(self, position: int) -> int:
        epoch, place = divmod(position, len(self.source))
        if self._order[0] != epoch:
            self._order = (epoch, self.source.epoch_indices(self.seed, epoch))
        return int(self._order[1][place])


def crop(frame: Frame, grid: VoxelGrid) -> Frame:
    """Keep the points of a window, in order: fewer to send and to sort."""
    x, y = frame.points[:, 0], frame.points[:, 1]
    (x0, y0, _), (x1, y1, _) = grid.minimum, grid.maximum
    return frame.with_points(frame.points[(x >= x0) & (x < x1) & (y >= y0) & (y < y1)])


def make_loader(dataset: TrainingDataset, start: int, end: int, workers: int) -> Iterator[TrainingBatch]:
    """Yield the batches of steps ``start`` to ``end`` - 1, prepared by ``workers`` background processes."""
    loader = DataLoader(
        dataset,
        batch_size=None,
        sampler=range(start, end),
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_quiet_worker if workers else None,
    )
    return iter(loader)


def _quiet_worker(_: int) -> None:
    """Leave Ctrl-C, and a SIGTERM to the whole group, to the training process, which ends its workers itself."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    torch.set_num_threads(1)
