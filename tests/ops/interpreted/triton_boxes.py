"""Triton kernels of boxes and segments, on a GPU or through Triton's interpreter (see test_triton.py)."""

import math

import pytest
import torch

from beambox.ops.nms import nms, nms_of_samples
from beambox.ops.nms import reference as plain_nms
from beambox.ops.rotated_iou import gpu, intersection_bev, iou_3d, iou_bev
from beambox.ops.rotated_iou import reference as plain
from beambox.ops.scatter import reference as plain_scatter
from beambox.ops.scatter import segment_max, segment_mean, segment_sum
from oracles.clouds import random_boxes
from oracles.loops import edit_distance

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def awkward(count):
    generator = torch.Generator().manual_seed(3)
    a, b = random_boxes(count, generator, 2), random_boxes(count, generator, 2)
    b[0], b[1, :6], b[2] = a[0], a[1, :6], a[2] + 1e-13
    b[3], b[4, 3], a[5, 3:5], b[6, :2] = a[3], 0, 0, 500
    b[1, 6] = a[1, 6] + math.pi / 2
    b[3, 3:6] /= 2
    b[7] = a[7]  # touching
    b[7, 0] += a[7, 3] * a[7, 6].cos()
    b[7, 1] += a[7, 3] * a[7, 6].sin()
    b[8, :2] += 1e4
    a[8, :2] += 1e4
    b[9, 0] = math.nan
    return a.to(DEVICE), b.to(DEVICE)


@pytest.mark.parametrize(
    ("frontend", "twin"),
    [(iou_bev, plain.iou_bev), (iou_3d, plain.iou_3d), (intersection_bev, plain.intersection_bev)],
    ids=["bev", "3d", "area"],
)
@pytest.mark.parametrize(("rows", "columns"), [(40, 37), (0, 5), (5, 0), (1, 1)])
def test_overlaps_equal_reference(frontend, twin, rows, columns):
    a, b = awkward(40)
    actual, want = frontend(a[:rows], b[:columns]), twin(a[:rows], b[:columns])
    assert actual.shape == (rows, columns)
    torch.testing.assert_close(actual, want, rtol=0, atol=1e-9)


def test_trapezia_agree_with_clipping_on_many_pairs():
    generator = torch.Generator().manual_seed(4)
    a, b = random_boxes(100, generator, 4).to(DEVICE), random_boxes(100, generator, 4).to(DEVICE)
    a[:50, 6] = torch.round(a[:50, 6])
    b[:50, 6] = a[:50, 6] + (torch.rand(50, generator=generator, dtype=torch.float64) * 1e-9).to(DEVICE)
    actual, want = gpu.intersection_bev(a, b), plain.intersection_bev(a, b)
    torch.testing.assert_close(actual, want, rtol=0, atol=1e-7)
    assert int((want > 0).sum()) > 2500


@pytest.mark.parametrize(("count", "threshold"), [(1, 0.1), (64, 0.01), (90, 0.5)])
def test_nms_equals_reference(count, threshold):
    generator = torch.Generator().manual_seed(count)
    boxes = random_boxes(count, generator, 6, torch.float32).to(DEVICE)
    scores = torch.rand(count, generator=generator).to(DEVICE)
    for limits in ((4096, 500), (70, 7)):
        actual = nms(boxes, scores, threshold, *limits).tolist()
        assert edit_distance(actual, plain_nms.nms(boxes, scores, threshold, *limits).tolist()) == 0


@pytest.mark.parametrize(
    ("places", "post", "extent"), [(1, 3, 5.0), (150, 200, 12.0), (150, 20, 3.0), (200, 90, 300.0)]
)
def test_nms_of_samples_equals_reference(places, post, extent):
    generator = torch.Generator().manual_seed(places)
    boxes = random_boxes(4 * places, generator, extent, torch.float32).view(4, places, 7).to(DEVICE)
    boxes[1] = boxes[1, :1]  # all the same
    count = torch.tensor([places, places, 0, places // 2], device=DEVICE)
    actual, want = (run(boxes, count, 0.1, post) for run in (nms_of_samples, plain_nms.nms_of_samples))
    assert actual[0].equal(want[0]) and actual[1].equal(want[1])
    assert actual[1][1] == 1 and actual[1][2] == 0


def test_a_chain_of_boxes_each_over_the_next_keeps_every_other():
    boxes = torch.tensor([0.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0], device=DEVICE).repeat(1, 130, 1)
    boxes[0, :, 0] = torch.arange(130, device=DEVICE) * 3.0
    count = torch.tensor([130], device=DEVICE)
    kept, number = nms_of_samples(boxes, count, 0.05, 100)
    assert kept[0, :65].tolist() == list(range(0, 130, 2)) and number.tolist() == [65]


@pytest.mark.parametrize(("rows", "columns", "size"), [(0, 3, 4), (1, 1, 1), (40, 7, 13), (30, 130, 4), (0, 5, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_segments_and_their_gradients_equal_reference(rows, columns, size, dtype):
    generator = torch.Generator().manual_seed(rows)
    values = torch.randn(rows, columns, generator=generator).to(dtype)
    values = torch.where(torch.rand(rows, columns, generator=generator) < 0.3, 0.5, values).to(DEVICE)  # ties
    segment = torch.randint(0, max(size, 1), (rows,), generator=generator).to(DEVICE)
    cotangent = torch.randn(size, columns, generator=generator).to(DEVICE, dtype)
    close = {"rtol": 2e-2, "atol": 2e-2} if dtype == torch.bfloat16 else {"rtol": 1e-5, "atol": 1e-6}
    for frontend, twin in (
        (segment_sum, plain_scatter.segment_sum),
        (segment_mean, plain_scatter.segment_mean),
        (segment_max, plain_scatter.segment_max),
    ):
        ours, theirs = values.clone().requires_grad_(), values.clone().requires_grad_()
        actual, want = frontend(ours, segment, size), twin(theirs, segment, size)
        torch.testing.assert_close(actual, want, **close)
        actual.backward(cotangent)
        want.backward(cotangent)
        torch.testing.assert_close(ours.grad, theirs.grad, **close)


def test_segment_max_shows_nan_and_takes_infinities():
    inf, nan = torch.inf, torch.nan
    values = torch.tensor([[1.0, -inf, inf, nan], [nan, -inf, 5.0, inf], [7.0, -inf, nan, 1.0]], device=DEVICE)
    values.requires_grad_()
    out = segment_max(values, torch.tensor([0, 0, 0], device=DEVICE), 1)
    torch.testing.assert_close(out.cpu(), torch.tensor([[nan, -inf, inf, nan]]), equal_nan=True)
    out.backward(torch.ones_like(out))
    assert values.grad.tolist() == [[0, 1, 1, 1], [1, 0, 0, 0], [0, 0, 0, 0]]
