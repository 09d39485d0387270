"""Proposals, sampling, targets and losses of the second stage."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beambox.geometry.boxes import wrap_angle
from beambox.layers.heads import PostProcess
from beambox.layers.roi import (
    Rois,
    RoiSampling,
    canonical_targets,
    corner_loss,
    decode_rois,
    overlap_score,
    roi_loss,
    sample_rois,
    select_rois,
)

CAR = torch.tensor([10.0, 2.0, -1.0, 4.0, 1.6, 1.5, 0.4])


def rois_near(box, offsets, labels=None):
    """Return regions that are the box moved along x."""
    boxes = box.repeat(len(offsets), 1)
    boxes[:, 0] += torch.tensor(offsets)
    labels = torch.zeros(len(offsets), dtype=torch.int64) if labels is None else torch.tensor(labels)
    return Rois(boxes, labels, torch.zeros(len(offsets), dtype=torch.int64), 1)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_sampling_keeps_the_published_shares():
    offsets = [0.0] * 100 + [2.0] * 60 + [50.0] * 300  # overlaps 1, about 0.3, 0
    targets = sample_rois(rois_near(CAR, offsets), [CAR[None]], [torch.zeros(1).long()], RoiSampling(), generator())
    assert len(targets.rois.boxes) == 128
    assert int((targets.iou >= 0.55).sum()) == 64
    assert int(((targets.iou >= 0.1) & (targets.iou < 0.55)).sum()) == int(0.8 * 64)
    assert targets.regress.equal(targets.iou > 0.55)
    assert targets.boxes[targets.regress].eq(CAR).all()


@pytest.mark.parametrize(
    ("offsets", "positive", "hard"),
    [([0.0] * 5, 128, 0), ([50.0] * 5, 0, 0), ([2.0] * 5, 0, 128), ([0.0, 2.0], 1, 127)],
)
def test_sampling_fills_up_from_what_there_is(offsets, positive, hard):
    targets = sample_rois(rois_near(CAR, offsets), [CAR[None]], [torch.zeros(1).long()], RoiSampling(), generator())
    assert int((targets.iou >= 0.55).sum()) == positive
    assert int(((targets.iou >= 0.1) & (targets.iou < 0.55)).sum()) == hard
    assert len(targets.iou) == 128


def test_regions_answer_for_objects_of_their_own_class():
    rois = rois_near(CAR, [0.0, 0.0], labels=[0, 1])
    targets = sample_rois(rois, [CAR[None]], [torch.tensor([1])], RoiSampling(rois_per_frame=20), generator())
    assert targets.iou[targets.rois.labels == 0].eq(0).all()
    assert targets.iou[targets.rois.labels == 1].gt(0.99).all()


def test_sampling_without_objects_teaches_background():
    targets = sample_rois(rois_near(CAR, [0.0, 1.0]), [torch.zeros(0, 7)], [torch.zeros(0).long()], RoiSampling())
    assert targets.score.eq(0).all()
    assert not targets.regress.any()
    losses = roi_loss(torch.zeros(128), torch.zeros(128, 7), targets)
    assert losses["roi_cls"] == pytest.approx(math.log(2))
    assert losses["roi_box"] == 0


def test_sampling_is_decided_by_the_generator():
    rois = rois_near(CAR, [i / 40 for i in range(300)])
    first, again, other = (
        sample_rois(rois, [CAR[None]], [torch.zeros(1).long()], RoiSampling(), generator(seed)) for seed in (1, 1, 2)
    )
    assert first.rois.boxes.equal(again.rois.boxes)
    assert not first.rois.boxes.equal(other.rois.boxes)


def test_score_rises_linearly_between_the_thresholds():
    assert overlap_score(torch.tensor([0.1, 0.25, 0.5, 0.75, 0.9]), RoiSampling()).tolist() == [0, 0, 0.5, 1, 1]


angle = st.floats(-math.pi, math.pi)
meter = st.floats(-3, 3)
size = st.floats(0.5, 5)


@settings(deadline=None)
@given(meter, meter, meter, size, size, size, angle, angle)
def test_decoding_undoes_the_canonical_targets(x, y, z, length, w, h, yaw, roi_yaw):
    roi = torch.tensor([[8.0, -3.0, -1.0, 4.2, 1.7, 1.4, roi_yaw]], dtype=torch.float64)
    box = torch.tensor([[8.0 + x, -3.0 + y, -1.0 + z, length, w, h, yaw]], dtype=torch.float64)
    decoded = decode_rois(canonical_targets(box, roi), roi)
    torch.testing.assert_close(decoded[:, :6], box[:, :6])
    assert float(wrap_angle(decoded[0, 6] - box[0, 6], 0.5, math.pi).abs()) < 1e-6  # up to a half turn
    assert float(wrap_angle(decoded[0, 6] - roi[0, 6]).abs()) <= math.pi / 2 + 1e-6


def test_corner_loss_forgives_a_half_turn():
    turned = CAR.clone()
    turned[6] += math.pi
    assert corner_loss(turned[None], CAR[None]).item() == pytest.approx(0, abs=1e-6)
    moved = CAR.clone()
    moved[2] += 0.5
    assert corner_loss(moved[None], CAR[None]).item() == pytest.approx(0.5 * 0.5**2, rel=1e-5)
    moved[2] += 1.5
    assert corner_loss(moved[None], CAR[None]).item() == pytest.approx(2 - 0.5, rel=1e-5)


def test_a_perfect_second_stage_costs_next_to_nothing():
    rois = rois_near(CAR, [0.0, 0.1, -0.1, 40.0])
    targets = sample_rois(rois, [CAR[None]], [torch.zeros(1).long()], RoiSampling(), generator())
    logits = torch.where(targets.score > 0.5, 20.0, -20.0)
    losses = roi_loss(logits, canonical_targets(targets.boxes, targets.rois.boxes), targets)
    assert all(value < 1e-4 for value in losses.values())


def test_selection_drops_low_scores_and_overlaps_sample_by_sample():
    rois = Rois(CAR.repeat(4, 1), torch.tensor([2, 0, 0, 1]), torch.tensor([0, 0, 0, 1]), 3)
    cls = torch.tensor([1.0, 3.0, -4.0, 0.5])
    (_, scores, labels), second, third = select_rois(rois, cls, rois.boxes, PostProcess(0.3, 0.1))
    assert labels.tolist() == [0]
    assert scores.tolist() == pytest.approx([1 / (1 + math.exp(-3.0))])
    assert second[2].tolist() == [1]
    assert len(third[0]) == 0
