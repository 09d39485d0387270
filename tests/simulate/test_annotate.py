from __future__ import annotations

import numpy as np
import torch

from beambox.simulate.annotate import annotate, occlusion_level
from beambox.simulate.frames import CAMERA
from beambox.simulate.raycast import Placed
from beambox.simulate.shapes import Shape

SIZE = (1242, 375)


def placed(x: float, y: float, name: str = "Car") -> Placed:
    return Placed(Shape(), (x, y, -1.7), 0.0, name=name, box=(x, y, -0.95, 4.0, 1.6, 1.5, 0.0) if name else ())


def test_occlusion_follows_the_share_of_beams_lost() -> None:
    unoccluded_hits = np.array([100, 100, 100, 100, 100, 100, 0])
    hits = np.array([100, 86, 84, 51, 49, 7, 0])
    np.testing.assert_array_equal(occlusion_level(unoccluded_hits, hits), [0, 0, 1, 1, 2, 3, 3])


def test_only_objects_that_are_met_and_shown_get_labels() -> None:
    things = [placed(20, 0), placed(20, 5), placed(-20, 0), placed(15, 0, ""), placed(10, 30)]
    unoccluded_hits, hits = np.array([100, 100, 100, 9, 50]), np.array([90, 0, 50, 9, 50])
    labels = annotate(things, unoccluded_hits, hits, CAMERA, SIZE, full=False)
    assert labels.boxes[:, 0].tolist() == [20.0]
    attributes = labels.attributes
    assert attributes.truncation.tolist() == [0.0]
    assert attributes.occlusion.tolist() == [0]
    torch.testing.assert_close(attributes.image, CAMERA.to_camera(labels.boxes, SIZE).image)


def test_full_view_labels_what_the_image_does_not_show() -> None:
    things = [placed(20, 0), placed(-20, 0)]
    labels = annotate(things, np.array([9, 9]), np.array([9, 4]), CAMERA, SIZE, full=True)
    assert labels.attributes.truncation.tolist() == [0.0, 1.0]
    assert labels.attributes.image[1].tolist() == [0, 0, 0, 0]
    assert labels.attributes.occlusion.tolist() == [0, 2]


def test_truncation_is_the_share_of_the_image_box_outside() -> None:
    labels = annotate([placed(6.0, 4.6)], np.array([9]), np.array([9]), CAMERA, SIZE, full=False)
    wide = CAMERA.to_camera(labels.boxes).image[0]
    clipped = labels.attributes.image[0]
    area = lambda b: float((b[2] - b[0]) * (b[3] - b[1]))
    assert 0.1 < float(labels.attributes.truncation[0]) < 0.9
    assert abs(float(labels.attributes.truncation[0]) - (1 - area(clipped) / area(wide))) < 1e-6
    assert float(clipped[0]) == 0.0


def test_no_objects_give_empty_labels() -> None:
    empty = np.zeros(0, np.int64)
    assert len(annotate([], empty, empty, CAMERA, SIZE, full=True)) == 0
