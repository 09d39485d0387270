"""Profiles of points in boxes, against objects whose points are put where they are asked for."""

from __future__ import annotations

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.simulate import SimulatedSource
from beambox.simulate.compare import compare_objects, object_profiles
from beambox.structures import Frame, ImageAttributes, Labels


def car(yaw: float, depth: float, occlusion: int = 0) -> Frame:
    """A sweep with one car 20 m ahead whose 40 points stand ``depth`` behind its nearest face, 0.75 m high."""
    box = torch.tensor([[20.0, 0.0, 0.0, 4.0, 1.6, 1.5, yaw]])
    points = torch.zeros(40, 4)
    points[:, 0], points[:, 3] = 20.0 - 2.0 + depth, 0.5
    points[:10, 3] = 0.0
    zero = torch.zeros(1)
    attributes = ImageAttributes(zero, torch.tensor([occlusion]), zero, torch.tensor([[0.0, 0.0, 50.0, 50.0]]))
    return Frame(points, id="one", labels=Labels(box, ("Car",), attributes))


@pytest.mark.parametrize(("yaw", "view"), [(0.0, "rear"), (3.14159265, "front")])
def test_profile_tells_depth_view_height_and_intensity(yaw: float, view: str) -> None:
    (profile,) = object_profiles([car(yaw, 0.3)], ("Car",))
    assert (profile.name, profile.view) == ("Car", view)
    points, depth, top_gap, lowest, intensity, zero = profile.measures
    assert points == 40
    assert depth == pytest.approx(0.3, abs=1e-5)
    assert top_gap == pytest.approx(0.75, abs=1e-5)
    assert lowest == pytest.approx(0.75, abs=1e-5)
    assert intensity == pytest.approx(0.375)
    assert zero == pytest.approx(0.25)
    assert profile.bands == (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # 0.45 to 0.6 of the height


def test_hidden_objects_other_classes_and_few_points_are_left_out() -> None:
    assert object_profiles([car(0.0, 0.3, occlusion=1)], ("Car",)) == []
    assert object_profiles([car(0.0, 0.3)], ("Van",)) == []
    assert object_profiles([car(0.0, 0.3)], ("Car",), least=41) == []


def test_unlabeled_frames_are_refused() -> None:
    with pytest.raises(BeamboxError, match="frame bare has no labels"):
        object_profiles([Frame(torch.zeros(1, 4), id="bare")], ("Car",))


def test_a_data_set_beside_itself_shows_no_difference() -> None:
    source = SimulatedSource(6, seed=5)
    comparison = compare_objects(source, source, ("Car",))
    assert comparison.rows
    for real, simulated in zip(comparison.rows[::2], comparison.rows[1::2]):
        assert (real[3], simulated[3]) == ("real", "simulated")
        assert real[4:] == simulated[4:]
    assert comparison.table().count("\n") == 1 + len(comparison.rows)
