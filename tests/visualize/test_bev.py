"""The picture from above: things are where they should be, in the colour they should have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from beambox.checks import BeamboxError
from beambox.structures import Detections, Frame, Labels
from beambox.visualize.bev import Region, draw_bev, region_of, score_alpha
from beambox.visualize.canvas import save_picture
from beambox.visualize.colors import BACKGROUND, TRUTH, class_color, gradient

REGION = Region(-10, -20, 50, 20)  # 60 m ahead, 40 m across: at 600 pixels, 10 a metre
NO_POINTS = Frame(torch.zeros(0, 4), "empty")


def near(picture: Image.Image, x: float, y: float, color: tuple[int, int, int], reach: int = 4) -> bool:
    """Whether a pixel close to a place in metres has nearly that colour."""
    u, v = round((REGION.y_max - y) * 10), round((REGION.x_max - x) * 10)
    patch = np.asarray(picture)[max(0, v - reach) : v + reach + 1, max(0, u - reach) : u + reach + 1].astype(int)
    return bool((np.abs(patch - np.array(color)).sum(axis=-1) < 60).any())


def box(x: float, y: float, yaw: float = 0.0) -> list[float]:
    return [x, y, 0.0, 4.0, 2.0, 1.5, yaw]


def test_points_are_drawn_forward_up_and_left_left() -> None:
    frame = Frame(torch.tensor([[30.0, 10.0, 0.0, 0.5], [5.0, -15.0, 2.0, 0.5]]))
    picture = np.asarray(draw_bev(frame, region=REGION, longest=600)).astype(int)
    bright = np.argwhere(np.abs(picture[:, :400] - np.array(BACKGROUND)).sum(axis=-1) > 60)
    places = {(v, u) for v, u in bright}
    for x, y in ((30, 10), (5, -15)):
        assert any(abs(v - (50 - x) * 10) < 3 and abs(u - (20 - y) * 10) < 3 for v, u in places), (x, y)


def test_labels_are_green_and_detections_have_the_color_of_their_class() -> None:
    labels = Labels(torch.tensor([box(20, 0)]), ("Car",))
    found = Detections(torch.tensor([box(35, 8)]), torch.tensor([0.9]), torch.tensor([1]), ("Car", "Cyclist"))
    picture = draw_bev(NO_POINTS, found, labels, region=REGION, longest=600)
    assert near(picture, 20, 1, TRUTH) and not near(picture, 20, 1, class_color("Cyclist"))
    assert near(picture, 35, 9, class_color("Cyclist")) and not near(picture, 35, 9, TRUTH)


def test_a_heading_leads_from_the_center_to_the_front() -> None:
    found = Detections(torch.tensor([box(20, 0, np.pi / 2)]), torch.tensor([0.9]), torch.tensor([0]), ("Car",))
    picture = draw_bev(NO_POINTS, found, region=REGION, longest=600)
    assert near(picture, 20, 1.0, class_color("Car"), reach=1), "yaw of a quarter turn points to +y, left"
    assert not near(picture, 20, -1.0, class_color("Car"), reach=1)


def test_surer_detections_are_more_opaque() -> None:
    assert score_alpha(0.0) < score_alpha(0.3) < score_alpha(0.6) < score_alpha(0.7) == score_alpha(1.0) == 255


def test_a_sweep_without_points_boxes_and_names_is_a_picture() -> None:
    picture = draw_bev(Frame(torch.zeros(0, 4)), Detections.empty(("Car",)), Labels.empty())
    assert picture.width > 300 and picture.height >= 420


@pytest.mark.parametrize("color_by", ["height", "intensity"])
def test_equal_values_and_far_points_do_not_break_it(color_by: str) -> None:
    points = torch.ones(50, 4)
    points[0, :2] = 1e6
    picture = draw_bev(Frame(points), region=REGION, color_by=color_by, longest=300)  # type: ignore[arg-type]
    assert picture.size == (450, 420)


def test_the_region_holds_the_sensor_nearly_all_points_and_every_box() -> None:
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform((5, -8, -2, 0), (60, 8, 1, 1), (2000, 4)).astype(np.float32))
    region = region_of(Frame(points), torch.tensor([box(10, 30)]))
    assert region.x_min < 0 and region.x_max >= 60 and region.y_max >= 33
    assert region.y_max - region.y_min >= 0.79 * (region.x_max - region.x_min), "no ribbon"
    assert all(value % 5 == 0 for value in (region.x_min, region.x_max))


def test_the_same_sweep_gives_the_same_picture() -> None:
    frame = Frame(torch.rand(500, 4, generator=torch.Generator().manual_seed(1)) * 30)
    one, two = (draw_bev(frame, region=REGION, longest=300) for _ in range(2))
    assert np.array_equal(np.asarray(one), np.asarray(two))


def test_gradient_grows_lighter_and_takes_anything() -> None:
    light = gradient(np.linspace(0, 1, 30)).astype(int).sum(axis=1)
    assert (np.diff(light) > 0).all()
    assert np.array_equal(gradient(np.array([-1, np.nan, 2])), gradient(np.array([0, 0, 1])))


def test_classes_keep_their_colors() -> None:
    assert class_color("Car") == class_color("car") != class_color("Pedestrian")
    assert class_color("Wheelbarrow") == class_color("wheelbarrow")


def test_pictures_are_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = Image.new("RGB", (4, 4))
    save_picture(picture, tmp_path / "new" / "a.png")
    save_picture(picture, tmp_path / "new" / "a.jpg")
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["a.jpg", "a.png"]
    with pytest.raises(BeamboxError, match=r"\.png or \.jpg, got the name a\.gif"):
        save_picture(picture, tmp_path / "a.gif")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(BeamboxError, match=r"b\.png: No space left on device; free some space"):
        save_picture(picture, tmp_path / "new" / "b.png")
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["a.jpg", "a.png"]
