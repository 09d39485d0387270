"""The stream of batches is a pure function of seed and step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from beambox.data.loader import MixedSource
from beambox.geometry.grid import VoxelGrid
from beambox.structures import Labels
from beambox.train.feed import choose_window, stream
from oracles.tiny_training import frames, tiny_run

GRID = VoxelGrid((0.0, -12.8, -3.0), (25.6, 12.8, 1.0), (0.16, 0.16, 4.0))


@given(st.integers(0, 10_000), st.integers(1, 20), st.integers(1, 20))
def test_window_contains_an_object_and_stays_on_the_grid(seed: int, wide: int, high: int) -> None:
    rng = np.random.default_rng(seed)
    centres = rng.uniform((0, -12.8, -2), (25.6, 12.8, 0), (4, 3))
    boxes = torch.tensor(np.column_stack((centres, np.ones((4, 3)), np.zeros(4))), dtype=torch.float32)
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
    one, other = tiny_run(tmp_path).feed, tiny_run(tmp_path).feed
    for _ in range(3):
        one[0], one[7]
    a, b = one[4], other[4]
    assert torch.equal(a.batch.points, b.batch.points)
    assert a.grid == b.grid
    assert a.batch.frame_ids == b.batch.frame_ids
    assert not torch.equal(one[5].batch.points[:50], a.batch.points[:50])


def test_processes_share_a_batch_in_order(tmp_path: Path) -> None:
    feed = tiny_run(tmp_path, window=None).feed
    whole = feed[3].batch
    feed.world = 2
    parts = []
    for feed.rank in (0, 1):
        parts.append(feed[3].batch)
    assert whole.frame_ids == parts[0].frame_ids + parts[1].frame_ids
    assert torch.equal(whole.points, torch.cat([part.points for part in parts]))


def test_a_frame_without_objects_is_replaced(tmp_path: Path) -> None:
    feed = tiny_run(tmp_path).feed
    source = frames(3)
    empty = source.frames[1].__class__(source.frames[1].points, "empty", Labels.empty())
    source.frames[1] = empty  # pyright: ignore
    feed.source = MixedSource([source])
    names = {feed.frame(position).id for position in range(9)}
    assert "empty" not in names


@pytest.mark.parametrize("workers", [0, 1])
def test_stream_yields_the_steps_asked_for(tmp_path: Path, workers: int) -> None:
    feed = tiny_run(tmp_path).feed
    got = [work.batch.frame_ids for work in stream(feed, 2, 5, workers)]
    assert got == [feed[step].batch.frame_ids for step in (2, 3, 4)]
