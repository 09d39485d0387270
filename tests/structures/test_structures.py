import pytest
import torch

from beambox.checks import BeamboxError
from beambox.structures import Batch, Detections, Frame, ImageAttributes, Labels

BOXES = torch.tensor([[10.0, 2, -1, 4, 2, 1.5, 0.5], [20, -3, -1, 0.8, 0.6, 1.7, 0], [30, 0, -1, 3.9, 1.6, 1.5, 3]])


def detections() -> Detections:
    return Detections(BOXES, torch.tensor([0.9, 0.5, 0.3]), torch.tensor([0, 1, 0]), ("Car", "Pedestrian"))


def test_detections_slice_like_a_sequence_and_by_mask() -> None:
    found = detections()
    assert len(found[found.scores > 0.4]) == 2
    assert found[1:].names == ["Pedestrian", "Car"]
    assert found[torch.tensor([2, 0])].scores.tolist() == pytest.approx([0.3, 0.9])
    assert len(Detections.empty(("Car",))) == 0


def test_rows_name_everything_in_the_lidar_frame() -> None:
    row = detections().to_rows()[0]
    assert list(row) == ["frame", "name", "score", "x", "y", "z", "l", "w", "h", "yaw"]
    assert row["name"] == "Car" and row["yaw"] == 0.5


@pytest.mark.parametrize(
    ("boxes", "scores", "labels", "message"),
    [
        (torch.zeros(2, 6), torch.zeros(2), torch.zeros(2), r"`boxes` must have shape \(N, 7\), got \(2, 6\)"),
        (torch.zeros(2, 7), torch.zeros(3), torch.zeros(2), "same length"),
        (torch.zeros(1, 7), torch.zeros(1), torch.tensor([5]), "must lie in 0 to 1"),
    ],
)
def test_detections_validate_at_birth(boxes, scores, labels, message) -> None:
    with pytest.raises(BeamboxError, match=message):
        Detections(boxes, scores, labels.long(), ("Car", "Pedestrian"))


def test_labels_select_classes_and_keep_attributes_aligned() -> None:
    attributes = ImageAttributes(
        torch.tensor([0.0, 0.2, 0.4]), torch.tensor([0, 1, 2]), torch.zeros(3), torch.tensor([[0.0, 0, 50, 60]] * 3)
    )
    labels = Labels(BOXES, ("Car", "Pedestrian", "Car"), attributes)
    cars = labels.of_classes(["Car"])
    assert cars.names == ("Car", "Car")
    assert cars.attributes is not None and cars.attributes.occlusion.tolist() == [0, 2]
    assert labels.class_index(["Pedestrian", "Car"]).tolist() == [1, 0, 1]
    assert labels.class_index(["Van"]).tolist() == [-1, -1, -1]


def test_difficulty_takes_the_first_level_that_fits() -> None:
    image = torch.tensor([[0.0, 0, 50, 39], [0, 0, 50, 38], [0, 0, 50, 24], [0, 0, 50, 23], [0, 0, 50, 60]])
    attributes = ImageAttributes(
        torch.tensor([0.15, 0.0, 0.5, 0.0, 0.0]), torch.tensor([0, 0, 2, 0, 3]), torch.zeros(5), image
    )
    assert attributes.difficulty().tolist() == [0, 1, 2, -1, -1]


def test_labels_refuse_what_cannot_be() -> None:
    with pytest.raises(BeamboxError, match="finite"):
        Labels(torch.full((1, 7), float("nan")), ("Car",))
    with pytest.raises(BeamboxError, match="at least 0"):
        Labels(torch.tensor([[0.0, 0, 0, -1, 1, 1, 0]]), ("Car",))
    with pytest.raises(BeamboxError, match="same length"):
        Labels(BOXES, ("Car",))


def test_batch_keeps_empty_sweeps_and_order() -> None:
    frames = [Frame(torch.ones(3, 4), id="a"), Frame(torch.zeros(0, 4), id="b"), Frame(torch.ones(2, 4), id="c")]
    batch = Batch.of(frames)
    assert batch.size == 3 and batch.sample.tolist() == [0, 0, 0, 2, 2]
    assert batch.frame_ids == ("a", "b", "c") and batch.labels is None


def test_batch_refuses_nothing_and_mixed_columns() -> None:
    with pytest.raises(BeamboxError, match="at least one frame"):
        Batch.of([])
    with pytest.raises(BeamboxError, match="same number of point columns"):
        Batch.of([Frame(torch.ones(3, 4)), Frame(torch.ones(3, 5))])


def test_frame_says_what_a_crop_needs() -> None:
    with pytest.raises(BeamboxError, match="no camera calibration"):
        Frame(torch.zeros(1, 4), id="000001").camera_view()
    with pytest.raises(BeamboxError, match="x, y, z, intensity"):
        Frame(torch.zeros(1, 3))
