"""Non-maximum suppression: against a plain loop over shapely's overlaps, numba against the reference."""

import numpy as np
import pytest
import torch

from beambox.checks import BeamboxError
from beambox.ops.nms import cpu, nms, reference
from oracles import loops, polygons
from oracles.clouds import random_boxes

VERSIONS = pytest.mark.parametrize("version", [reference.nms, cpu.nms], ids=["reference", "numba"])


def shapely_iou(boxes):
    n = len(boxes)
    rows, columns = np.divmod(np.arange(n * n), n)
    return polygons.paired_iou_bev(boxes[rows], boxes[columns]).reshape(n, n)


@VERSIONS
@pytest.mark.parametrize("count", [1, 2, 60])
@pytest.mark.parametrize("threshold", [0.0, 0.1, 0.7])
@pytest.mark.parametrize("limits", [(4096, 500), (20, 500), (4096, 5)])
def test_nms_agrees_with_plain_loop(version, count, threshold, limits):
    generator = torch.Generator().manual_seed(count)
    boxes, scores = random_boxes(count, generator, 5), torch.rand(count, generator=generator)
    boxes[count // 2 :] = boxes[: count - count // 2] + 0.1  # overlaps of all degrees
    want = loops.nms(shapely_iou(boxes.numpy()), scores.tolist(), threshold, *limits)
    assert version(boxes, scores, threshold, *limits).tolist() == want


@pytest.mark.parametrize("threshold", [0.01, 0.1, 0.5, 0.7])
def test_numba_nms_is_close_to_reference_on_many_boxes(threshold):
    generator = torch.Generator().manual_seed(1)
    boxes = random_boxes(1500, generator, 25, torch.float32)
    scores = (torch.rand(1500, generator=generator) * 50).round() / 50  # many ties
    actual, want = cpu.nms(boxes, scores, threshold), reference.nms(boxes, scores, threshold)
    # The versions round differently in the last bits, so an overlap at the very threshold may flip one box.
    assert loops.edit_distance(actual.tolist(), want.tolist()) <= 1
    assert len(want) > 50


@VERSIONS
def test_nms_keeps_the_first_of_equals(version):
    boxes = random_boxes(1, torch.Generator().manual_seed(2)).repeat(4, 1)
    boxes[3, 0] += 50
    assert version(boxes, torch.tensor([0.5, 0.5, 0.5, 0.5]), 0.5).tolist() == [0, 3]


@VERSIONS
def test_nms_drops_above_and_not_at_the_threshold(version):
    half = torch.tensor([[0.0, 0, 0, 2, 2, 1, 0], [1.0, 0, 0, 2, 2, 1, 0]])  # share 2 of 6 square metres
    assert version(half, torch.tensor([0.2, 0.9]), 1 / 3 + 1e-9).tolist() == [1, 0]
    assert version(half, torch.tensor([0.2, 0.9]), 1 / 3 - 1e-9).tolist() == [1]
    touching = half + torch.tensor([[0.0] * 7, [1.0, 0, 0, 0, 0, 0, 0]])
    assert version(touching, torch.tensor([0.2, 0.9]), 0.0).tolist() == [1, 0]


@VERSIONS
def test_nms_never_drops_flat_boxes(version):
    flat = torch.zeros(3, 7)
    assert version(flat, torch.tensor([0.1, 0.2, 0.3]), 0.0).tolist() == [2, 1, 0]


def test_nms_of_nothing_and_of_nan_scores():
    assert nms(torch.zeros(0, 7), torch.zeros(0), 0.5).shape == (0,)
    boxes = random_boxes(3, torch.Generator().manual_seed(3), 100)
    assert nms(boxes, torch.tensor([torch.nan, 0.1, 0.2]), 0.5).tolist() == [2, 1]
    assert nms(boxes, torch.full((3,), torch.nan), 0.5).tolist() == []
    assert nms(boxes, torch.ones(3), 0.5, post=0).tolist() == []


def test_nms_takes_boxes_and_scores_that_require_a_gradient():
    boxes = random_boxes(5, torch.Generator().manual_seed(4)).requires_grad_()
    scores = torch.rand(5, requires_grad=True)
    assert not nms(boxes, scores, 0.5).is_floating_point()


def test_nms_tells_what_is_wrong():
    with pytest.raises(BeamboxError, match=r"`scores` must have shape \(2\), got \(3,\)"):
        nms(torch.zeros(2, 7), torch.zeros(3), 0.5)
    with pytest.raises(BeamboxError, match=r"`pre` and `post` must not be negative, got 4096 and -1"):
        nms(torch.zeros(2, 7), torch.zeros(2), 0.5, post=-1)
