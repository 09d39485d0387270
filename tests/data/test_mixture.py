"""Shares of an epoch, and orders that depend on nothing but seed and number."""

from __future__ import annotations

import pytest

from beambox.checks import BeamboxError
from beambox.data.mixture import MixedSource
from beambox.data.source import FrameList, SubsetSource
from oracles.scenes import scene

SOURCE = FrameList([scene(k, ground=50) for k in range(10)])
OTHER = FrameList([scene(50 + k, ground=20) for k in range(4)])


def test_an_epoch_visits_every_frame_in_its_own_order() -> None:
    orders = [MixedSource([SOURCE, OTHER]).epoch_indices(1, epoch).tolist() for epoch in (0, 1, 0)]
    assert sorted(orders[0]) == sorted(orders[1]) == list(range(14))
    assert orders[0] == orders[2] != orders[1]
    assert orders[0] != MixedSource([SOURCE, OTHER]).epoch_indices(2, 0).tolist()


def test_a_mixture_takes_its_shares_and_repeats_late() -> None:
    mixed = MixedSource([SOURCE, OTHER], weights=[1, 3], epoch_length=8)
    assert len(mixed) == 14 and mixed.ids[10] == "1:000050" and mixed[12].id == "000052"
    orders = [mixed.epoch_indices(0, k).tolist() for k in range(5)]
    assert all(sum(i >= 10 for i in order) == 6 and len(order) == 8 for order in orders)
    assert sorted(i for order in orders for i in order if i < 10) == list(range(10))
    assert sorted(i for order in orders[:2] for i in order if i >= 10) == sorted([10, 11, 12, 13] * 3)


def test_what_is_not_there_is_refused() -> None:
    with pytest.raises(BeamboxError, match="these must have the same length: `weights` has 1, `sources` has 2"):
        MixedSource([SOURCE, OTHER], weights=[1])
    with pytest.raises(BeamboxError, match="a mixture needs at least one source, got none"):
        MixedSource([])
    with pytest.raises(BeamboxError, match=r"`weights` must be at least 0 and not all 0, got \[0, 0\]"):
        MixedSource([SOURCE, OTHER], weights=[0, 0])
    with pytest.raises(IndexError):
        MixedSource([SOURCE, OTHER])[14]
    with pytest.raises(BeamboxError, match="`indices` must lie in 0 to 9, the source's frames; got 10"):
        SubsetSource(SOURCE, [10])
    assert SubsetSource(SOURCE, [3, 1]).ids == ["000003", "000001"]
