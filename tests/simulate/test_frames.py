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


@pytest.mark.parametrize("index", range(4))
def test_boxes_hold_the_points_of_their_objects(index: int) -> None:
    frame = simulate_frame(17, index)
    boxes, points = frame.labels.boxes, frame.points[:, :3]
    assert len(boxes) > 0
    local = points[None] - boxes[:, None, :3]  # (M, N, 3)
    c, s = torch.cos(boxes[:, 6])[:, None], torch.sin(boxes[:, 6])[:, None]
    u = (c * local[..., 0] + s * local[..., 1]).abs()
    v = (c * local[..., 1] - s * local[..., 0]).abs()
    w = local[..., 2]
    half = boxes[:, None, 3:6] / 2
    # Clear of the ground and a little beside the box there is nothing but scenery, which stands off objects.
    high = (w > -half[..., 2] + 0.35) & (w < half[..., 2] + 0.3)
    inside = high & (u < half[..., 0] + 0.05) & (v < half[..., 1] + 0.05)
    beside = high & ~inside & (u < half[..., 0] + 0.12) & (v < half[..., 1] + 0.12)
    assert float(inside.sum()) >= 0.95 * float((inside | beside).sum())
    assert int((inside.sum(dim=1) > 0).sum()) >= 0.7 * len(boxes)


def test_full_view_goes_around() -> None:
    frame = simulate_frame(1, 2, view="full")
    azimuth = torch.atan2(frame.points[:, 1], frame.points[:, 0])
    assert torch.histc(azimuth, 8, -torch.pi, torch.pi).min() > 2000
    assert 60_000 < len(frame) < 130_000


def test_frame_looks_like_a_sweep_of_the_sensor() -> None:
    points = simulate_frame(8, 1).points
    distance = points[:, :3].norm(dim=1)
    assert float(distance.max()) <= 80.2
    assert float(distance.min()) > 0.9
    assert float(points[:, 3].min()) >= 0.0
    assert float(points[:, 3].max()) < 1.0
    road = points[(points[:, 0] < 10) & (points[:, 1].abs() < 1.5) & (points[:, 2] < -1.2), 2]
    assert abs(float(road.median()) + 1.7) < 0.15
