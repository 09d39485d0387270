"""The stream of batches is a pure function of seed and step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from beambox.checks import BeamboxError
from beambox.data.database import ObjectDatabase
from beambox.data.mixture import MixedSource
from beambox.data.source import FrameList
from beambox.geometry.grid import VoxelGrid
from beambox.structures import Labels
from beambox.train.config import AugmentSection
from beambox.train.dataset import TrainingBatch, TrainingDataset, choose_window, make_loader
from beambox.train.sources import Augment
from oracles.scenes import scene
from oracles.tiny_training import frames, shuffled, tiny_run

GRID = VoxelGrid((0.0, -12.8, -3.0), (25.6, 12.8, 1.0), (0.16, 0.16, 4.0))


@given(st.integers(0, 10_000), st.integers(1, 20), st.integers(1, 20))
def test_window_contains_an_object_and_stays_on_the_grid(seed: int, wide: int, high: int) -> None:
    rng = np.random.default_rng(seed)
    centers = rng.uniform((0, -12.8, -2), (25.6, 12.8, 0), (4, 3))
    boxes = torch.tensor(np.column_stack((centers, np.ones((4, 3)), np.zeros(4))), dtype=torch.float32)
    cells = (8 * wide, 8 * high)
    window = choose_window([Labels(boxes, ("Car",) * 4)], ["Car"], GRID, cells, rng)
    assert window.size[:2] == cells
    assert bool(window.contains(boxes).any())
    first = [round((low - start) / 0.16) for low, start in zip(window.minimum[:2], GRID.minimum[:2])]
    assert all(one % 8 == 0 and 0 <= one <= 160 - size for one, size in zip(first, cells))


def test_window_larger_than_the_grid_is_the_grid_and_without_objects_it_is_anywhere() -> None:
    rng = np.random.default_rng(0)
    assert choose_window([Labels.empty()], ["Car"], GRID, (800, 800), rng).size == GRID.size
    starts = {choose_window([Labels.empty()], ["Car"], GRID, (64, 64), rng).minimum for _ in range(20)}
    assert len(starts) > 5


def test_feed_depends_on_the_step_alone(tmp_path: Path) -> None:
    one, other = tiny_run(tmp_path).dataset, tiny_run(tmp_path).dataset
    for _ in range(3):
        one[0], one[7]
    a, b = one[4], other[4]
    assert torch.equal(a.batch.points, b.batch.points)
    assert a.grid == b.grid
    assert a.batch.frame_ids == b.batch.frame_ids
    assert not torch.equal(one[5].batch.points[:50], a.batch.points[:50])


def test_processes_share_a_batch_in_order(tmp_path: Path) -> None:
    dataset = tiny_run(tmp_path, window=None).dataset
    whole = dataset[3].batch
    dataset.world = 2
    parts = []
    for dataset.rank in (0, 1):
        parts.append(dataset[3].batch)
    assert whole.frame_ids == parts[0].frame_ids + parts[1].frame_ids
    assert torch.equal(whole.points, torch.cat([part.points for part in parts]))


def test_a_frame_without_objects_is_replaced(tmp_path: Path) -> None:
    dataset = tiny_run(tmp_path).dataset
    source = frames(3)
    empty = source.frames[1].__class__(source.frames[1].points, "empty", Labels.empty())
    source.frames[1] = empty  # pyright: ignore
    dataset.source = MixedSource([source])
    names = {dataset.frame(position).id for position in range(9)}
    assert "empty" not in names
    dataset.source = MixedSource([FrameList([empty])])
    assert dataset.frame(0).id == "empty", "where there is no other, it stays"


def sampling_dataset(**changes: Any) -> TrainingDataset:
    """Batches with everything that draws: a mixture, sampled objects, augmentation, windows."""
    near, far = (FrameList([scene(first + k, ground=50) for k in range(4)]) for first in (0, 50))
    augmentation = AugmentSection(sample={"Car": 3}, rotation=0.5, flip_x=0.5)
    augment = Augment(augmentation, ObjectDatabase.build(near, ["Car"]), seed=5)
    grid = VoxelGrid((0.0, -25.6, -3.0), (51.2, 25.6, 1.0), (0.4, 0.4, 4.0))
    options: dict[str, Any] = {"batch": 2, "window": (64, 64), "seed": 5, **changes}
    return TrainingDataset(MixedSource([near, far], [1, 3]), augment, ("Car",), grid, **options)


def same(one: TrainingBatch, other: TrainingBatch) -> bool:
    assert one.batch.labels is not None and other.batch.labels is not None
    boxes = all(torch.equal(a.boxes, b.boxes) for a, b in zip(one.batch.labels, other.batch.labels, strict=True))
    points = torch.equal(one.batch.points, other.batch.points)
    return one.batch.frame_ids == other.batch.frame_ids and one.grid == other.grid and points and boxes


@pytest.mark.parametrize("workers", [0, 1])
def test_a_stream_continues_as_if_it_had_not_stopped(workers: int) -> None:
    whole = list(make_loader(sampling_dataset(), 0, 9, 0))
    rest = list(make_loader(sampling_dataset(), 3, 9, workers))
    assert [same(a, b) for a, b in zip(whole[3:], rest, strict=True)] == [True] * 6
    assert not same(whole[3], sampling_dataset(seed=6)[3])
    assert not same(whole[3], whole[7]), "the second epoch has an order of its own"


def test_what_cannot_be_shared_or_drawn_is_said() -> None:
    with pytest.raises(BeamboxError, match="batch = 2 frames cannot be shared evenly by 3 processes"):
        sampling_dataset(world=3)
    with pytest.raises(BeamboxError, match="there are no training frames"):
        TrainingDataset(MixedSource([FrameList([])]), shuffled, ("Car",), GRID, 2)
