"""Order, resuming, sharing between ranks, and what a batch holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.augment import AugmentConfig
from beambox.data.database import ObjectDatabase
from beambox.data.loader import FrameLoader, MixedSource, epoch_order, prepare_frame
from beambox.data.source import FrameList, SubsetSource
from beambox.geometry import VoxelGrid
from beambox.structures import Batch, Labels
from oracles.scenes import scene

SOURCE = FrameList([scene(k, ground=50) for k in range(10)])
GRID = VoxelGrid((0, -20, -3), (30, 20, 1), (0.5, 0.5, 4))


def names(batches: list[Batch]) -> list[tuple[str, ...]]:
    return [batch.frame_ids for batch in batches]


def same(a: Batch, b: Batch) -> bool:
    assert a.labels is not None and b.labels is not None
    boxes = all(torch.equal(p.boxes, q.boxes) for p, q in zip(a.labels, b.labels))
    return a.frame_ids == b.frame_ids and torch.equal(a.points, b.points) and boxes


def trainer(**changes) -> FrameLoader:
    database = ObjectDatabase.build(SOURCE, ["Car"])
    options = {"batch_size": 3, "seed": 5, "augmentation": AugmentConfig(sample={"Car": 3}), "database": database}
    return FrameLoader(SOURCE, **{**options, **changes})


def test_without_augmentation_frames_come_as_they_are() -> None:
    batches = list(FrameLoader(SOURCE, 4, shuffle=False).epoch(0))
    assert names(batches) == [tuple(SOURCE.ids[:4]), tuple(SOURCE.ids[4:8]), tuple(SOURCE.ids[8:])]
    assert torch.equal(batches[0].points[: len(SOURCE[0])], SOURCE[0].points)
    assert batches[2].size == 2 and batches[2].labels is not None


def test_an_epoch_visits_every_frame_in_its_own_order() -> None:
    loader = FrameLoader(SOURCE, 3, seed=1, drop_last=False)
    epochs = [sum(names(list(loader.epoch(k))), ()) for k in (0, 1, 0)]
    assert sorted(epochs[0]) == sorted(epochs[1]) == sorted(SOURCE.ids)
    assert epochs[0] == epochs[2] != epochs[1]
    assert len(loader) == 4 and len(FrameLoader(SOURCE, 3)) == 3


def test_a_resumed_epoch_continues_as_if_it_had_not_stopped() -> None:
    whole = list(trainer().epoch(2))
    rest = list(trainer().epoch(2, start=1))
    assert len(whole) == 3 and all(same(a, b) for a, b in zip(whole[1:], rest, strict=True))
    assert not same(whole[0], next(iter(trainer(seed=6).epoch(2))))


def test_workers_do_not_change_what_comes() -> None:
    here, elsewhere = list(trainer().epoch(1)), list(trainer(workers=1).epoch(1))
    assert all(same(a, b) for a, b in zip(here, elsewhere, strict=True))


def test_ranks_share_an_epoch() -> None:
    alone = sum(names(list(trainer(batch_size=4, world=1).epoch(0))), ())
    ranks = [names(list(trainer(batch_size=2, rank=r, world=2).epoch(0))) for r in (0, 1)]
    assert len(ranks[0]) == len(ranks[1]) == 2
    assert tuple(np.stack([sum(r, ()) for r in ranks], axis=1).reshape(-1)) == alone[:8]
    uneven = [FrameLoader(SOURCE, 2, shuffle=False, rank=r, world=3) for r in range(3)]
    assert sorted(sum((sum(names(list(u.epoch(0))), ()) for u in uneven), ())) == sorted(SOURCE.ids)


def test_a_source_smaller_than_a_batch_still_gives_one() -> None:
    assert names(list(FrameLoader(FrameList([scene(0)]), 4).epoch(0))) == [("000000",)]


def test_a_mixture_takes_its_shares_and_repeats_late() -> None:
    other = FrameList([scene(50 + k, ground=20) for k in range(4)])
    mixed = MixedSource([SOURCE, other], weights=[1, 3], epoch_length=8)
    assert len(mixed) == 14 and mixed.ids[10] == "1:000050" and mixed[12].id == "000052"
    orders = [epoch_order(mixed, 0, k).tolist() for k in range(5)]
    assert all(sum(i >= 10 for i in order) == 6 and len(order) == 8 for order in orders)
    assert sorted(i for order in orders for i in order if i < 10) == list(range(10))
    assert sorted(i for order in orders[:2] for i in order if i >= 10) == sorted([10, 11, 12, 13] * 3)
    assert sorted(epoch_order(MixedSource([SOURCE, other]), 0, 3)) == list(range(14))
    assert sum(batch.size for batch in FrameLoader(mixed, 2).epoch(0)) == 8
    with pytest.raises(BeamboxError, match="these must have the same length: `weights` has 1, `sources` has 2"):
        MixedSource([SOURCE, other], weights=[1])
    with pytest.raises(IndexError):
        mixed[14]


def test_a_detector_gets_only_what_it_can_use() -> None:
    frame = scene(1)
    labels = frame.labels
    assert labels is not None
    named = replace(frame, labels=Labels(labels.boxes, ("Car", "Van", "Car", "Car")))
    ready = prepare_frame(named, ["Car"], GRID)
    assert ready.labels is not None
    inside = (labels.boxes[:, 0] <= 30) & (labels.boxes[:, 1].abs() <= 20)
    expected = inside & torch.tensor([True, False, True, True])
    assert torch.equal(ready.labels.boxes, labels.boxes[expected])
    assert torch.equal(GRID.index(ready.points)[0], GRID.index(frame.points)[0][GRID.index(frame.points)[1]])


def test_a_frame_left_without_objects_is_replaced() -> None:
    empty = [replace(scene(k), labels=Labels.empty(), id=f"empty{k}") for k in range(3)]
    source = FrameList([*empty, scene(9)])
    plain = AugmentConfig(sample={})
    ids = {name for b in FrameLoader(source, 4, augmentation=plain).epoch(0) for name in b.frame_ids}
    assert ids == {"000009"}
    assert FrameLoader(FrameList(empty), 3, augmentation=plain).epoch(0).__next__().size == 3


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(BeamboxError, match="got 0, rank 0 of 1, 0 and 0"):
        FrameLoader(SOURCE, 0)
    with pytest.raises(BeamboxError, match="the source is empty"):
        FrameLoader(FrameList([]), 1)
    with pytest.raises(BeamboxError, match="`indices` must lie in 0 to 9, the source's frames; got 10"):
        SubsetSource(SOURCE, [10])
    assert SubsetSource(SOURCE, [3, 1]).ids == ["000003", "000001"]
