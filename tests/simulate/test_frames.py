from __future__ import annotations

import pytest
import torch

from beambox.checks import BeamboxError, MissingFileError
from beambox.simulate import SimulatedSource, simulate_frame


def test_same_seed_and_index_give_the_same_frame() -> None:
    first, again, other = simulate_frame(3, 5), simulate_frame(3, 5), simulate_frame(3, 6)
    assert torch.equal(first.points, again.points)
    assert torch.equal(first.labels.boxes, again.labels.boxes)
    assert first.labels.names == again.labels.names
    assert first.points.shape != other.points.shape or not torch.equal(first.points, other.points)


def test_camera_view_keeps_only_what_the_camera_sees() -> None:
    frame = simulate_frame(0, 0)
    assert bool(frame.calibration.in_view(frame.points, frame.image_size).all())
    assert 5_000 < len(frame) < 30_000


def test_source_gives_the_frames_of_its_seed() -> None:
    source = SimulatedSource(frames=3, seed=3, first=5)
    assert len(source) == 3
    assert source.ids == ["000005", "000006", "000007"]
    assert torch.equal(source[0].points, simulate_frame(3, 5).points)
    with pytest.raises(IndexError):
        source[3]


def test_unknown_arguments_are_refused_with_a_hint(tmp_path) -> None:
    with pytest.raises(BeamboxError, match="got 'hdl46'"):
        simulate_frame(0, 0, sensor="hdl46")
    with pytest.raises(BeamboxError, match="`view` must be camera or full, got 'front'"):
        simulate_frame(0, 0, view="front")
    with pytest.raises(BeamboxError, match="`layout` must be random, kitti:PATH or mixed:PATH"):
        simulate_frame(0, 0, layout="town")
    with pytest.raises(MissingFileError, match="none is not there"):
        simulate_frame(0, 0, layout=f"kitti:{tmp_path}/none")
