"""Overlap of rotated boxes: against shapely, against closed forms, numba against the reference."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from beambox.checks import BeamboxError
from beambox.ops.rotated_iou import cpu, intersection_bev, iou_3d, iou_bev, reference
from oracles import polygons
from oracles.clouds import random_boxes

VERSIONS = pytest.mark.parametrize("version", [reference, cpu], ids=["reference", "numba"])


def box(x=0.0, y=0.0, z=0.0, l=4.0, w=2.0, h=1.5, yaw=0.0):  # noqa: E741 - the names of a box's columns
    return torch.tensor([[x, y, z, l, w, h, yaw]], dtype=torch.float64)


def awkward_pairs(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return pairs, a tenth each identical, turned by right angles, touching, nested, flat, far away, nearly equal."""
    generator = torch.Generator().manual_seed(11)
    a, b = random_boxes(count, generator, 3.0), random_boxes(count, generator, 3.0)
    tenth = count // 10
    part = [slice(i * tenth, (i + 1) * tenth) for i in range(10)]
    b[part[0]] = a[part[0]]
    b[part[1]] = a[part[1]]
    b[part[1], 6] += math.pi / 2 * torch.randint(-4, 5, (tenth,), generator=generator)
    b[part[2]] = a[part[2]]  # touching along an edge
    b[part[2], 0] += a[part[2], 3] * a[part[2], 6].cos()
    b[part[2], 1] += a[part[2], 3] * a[part[2], 6].sin()
    b[part[3]] = a[part[3]]
    b[part[3], 3:6] *= 0.5
    b[part[4], 3] = 0
    a[part[4], 4] = torch.where(torch.arange(tenth) % 2 == 0, 0.0, a[part[4], 4])
    a[part[5], :2] += 1e4
    b[part[5], :2] += 1e4
    b[part[6], :2] += 500
    b[part[7]] = a[part[7]] + torch.randn(tenth, 7, generator=generator, dtype=torch.float64) * 1e-12
    return a, b


@VERSIONS
def test_paired_iou_agrees_with_shapely(version):
    a, b = awkward_pairs(10_000)
    actual = {"area": [], "bev": [], "3d": []}
    for i, j in zip(a.split(40), b.split(40)):  # the diagonal of blocks
        actual["area"].append(version.intersection_bev(i, j).diagonal())
        actual["bev"].append(version.iou_bev(i, j).diagonal())
        actual["3d"].append(version.iou_3d(i, j).diagonal())
    a, b = a.numpy(), b.numpy()
    np.testing.assert_allclose(torch.cat(actual["area"]), polygons.paired_intersection(a, b), atol=1e-5)
    np.testing.assert_allclose(torch.cat(actual["bev"]), polygons.paired_iou_bev(a, b), atol=1e-5)
    np.testing.assert_allclose(torch.cat(actual["3d"]), polygons.paired_iou_3d(a, b), atol=1e-5)


@pytest.mark.parametrize("name", ["iou_bev", "iou_3d", "intersection_bev"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numba_equals_reference_on_all_pairs(name, dtype):
    generator = torch.Generator().manual_seed(2)
    a, b = random_boxes(61, generator, 6, dtype), random_boxes(47, generator, 6, dtype)
    b[:9] = a[:9]
    versions = {"iou_bev": (cpu.iou_bev, reference.iou_bev), "iou_3d": (cpu.iou_3d, reference.iou_3d)}
    fast, plain = versions.get(name, (cpu.intersection_bev, reference.intersection_bev))
    actual, want = fast(a, b), plain(a, b)
    assert actual.dtype == want.dtype == dtype
    torch.testing.assert_close(actual, want, rtol=0, atol=1e-12 if dtype == torch.float64 else 1e-6)


@VERSIONS
def test_closed_forms(version):
    area = lambda p, q: float(version.intersection_bev(p, q))
    assert area(box(), box()) == 8
    assert area(box(), box(yaw=math.pi)) == pytest.approx(8, abs=1e-12)
    assert area(box(), box(yaw=math.pi / 2)) == pytest.approx(4, abs=1e-12)
    assert area(box(), box(x=1, y=0.5)) == pytest.approx(3 * 1.5, abs=1e-12)
    assert area(box(l=2), box(l=2, yaw=math.pi / 4)) == pytest.approx(8 * (math.sqrt(2) - 1), abs=1e-12)  # octagon
    assert area(box(), box(x=4)) == 0
    assert float(version.iou_3d(box(), box(z=0.75))) == pytest.approx(1 / 3, abs=1e-12)
    assert float(version.iou_3d(box(), box(z=1.5))) == 0


@VERSIONS
@pytest.mark.parametrize("flat", [{"l": 0.0}, {"w": 0.0}, {"l": 0.0, "w": 0.0}, {"l": -1.0}, {"h": 0.0}])
def test_flat_boxes_have_iou_zero_and_no_nan(version, flat):
    a, b = box(**flat), torch.cat((box(**flat), box(), box(yaw=1.0)))
    assert version.iou_3d(a, b).tolist() == [[0, 0, 0]]
    if "h" not in flat:
        assert version.iou_bev(a, b).tolist() == [[0, 0, 0]]
        assert version.intersection_bev(b, a).tolist() == [[0], [0], [0]]


@VERSIONS
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_boxes_that_are_not_finite_share_nothing(version, value):
    bad = torch.cat([box().index_fill(1, torch.tensor([column]), value) for column in range(7)])
    for operation in (version.intersection_bev, version.iou_bev, version.iou_3d):
        assert (operation(bad, box()) == 0).all()
        assert (operation(box(), bad) == 0).all()


@VERSIONS
def test_nothing_meets_nothing(version):
    none, some = torch.zeros(0, 7), box().repeat(3, 1)
    assert version.iou_bev(none, some).shape == (0, 3)
    assert version.iou_3d(some, none).shape == (3, 0)
    assert version.intersection_bev(none, none).shape == (0, 0)


sizes = st.floats(0.01, 30)
anywhere = st.floats(-20, 20)
boxes = st.tuples(anywhere, anywhere, anywhere, sizes, sizes, sizes, st.floats(-7, 7))


@settings(max_examples=150, deadline=None)
@given(boxes, boxes, st.floats(-7, 7), st.floats(-1e4, 1e4))
def test_iou_is_symmetric_bounded_and_moves_with_the_world(a, b, turn, shift):
    p, q = torch.tensor([a], dtype=torch.float64), torch.tensor([b], dtype=torch.float64)
    for version in (reference, cpu):
        there, back = float(version.iou_bev(p, q)), float(version.iou_bev(q, p))
        assert there == pytest.approx(back, abs=1e-9)
        assert 0 <= there <= 1
        moved = []
        for boxes in (p, q):
            cos, sin = math.cos(turn), math.sin(turn)
            out = boxes.clone()
            out[:, 0] = cos * boxes[:, 0] - sin * boxes[:, 1] + shift
            out[:, 1] = sin * boxes[:, 0] + cos * boxes[:, 1] - shift
            out[:, 6] += turn
            moved.append(out)
        assert float(version.iou_bev(*moved)) == pytest.approx(there, abs=1e-6)


def test_gradient_of_the_reference():
    generator = torch.Generator().manual_seed(5)
    a, b = random_boxes(4, generator, 2).requires_grad_(), random_boxes(3, generator, 2).requires_grad_()
    assert torch.autograd.gradcheck(reference.iou_bev, (a, b))
    assert torch.autograd.gradcheck(reference.iou_3d, (a, b))


def test_doors_give_gradients_where_asked_and_speed_otherwise():
    a = random_boxes(3, torch.Generator().manual_seed(6), 1).requires_grad_()
    for frontend in (iou_bev, iou_3d, intersection_bev):
        assert frontend(a, a.detach()).requires_grad
        with torch.no_grad():
            assert not frontend(a, a).requires_grad


def test_doors_tell_what_is_wrong():
    with pytest.raises(BeamboxError, match=r"`b` must have shape \(any, 7\), got \(2, 5\)"):
        iou_bev(torch.zeros(1, 7), torch.zeros(2, 5))
    with pytest.raises(BeamboxError, match=r"`a` must be floating point, got int64"):
        iou_3d(torch.zeros(1, 7, dtype=torch.int64), torch.zeros(2, 7))
