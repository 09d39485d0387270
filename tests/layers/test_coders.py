import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from beambox.layers.coders import decode_boxes, direction_bin, encode_boxes, resolve_heading

ANCHOR = torch.tensor([10.0, 0, -1, 3.9, 1.6, 1.56, 0])


def test_code_of_a_known_box() -> None:
    box = torch.tensor([10.5, 0.2, -0.9, 4.2, 1.7, 1.5, 0.1])
    expected = torch.tensor([0.118611, 0.047445, 0.064103, 0.074108, 0.060625, -0.039221, 0.1])
    torch.testing.assert_close(encode_boxes(box, ANCHOR), expected, atol=1e-6, rtol=0)


@given(arrays("float64", (5, 7), elements=st.floats(0.1, 50)))
def test_decode_inverts_encode(values) -> None:
    boxes = torch.from_numpy(values)
    anchors = ANCHOR.double().expand(5, 7)
    torch.testing.assert_close(decode_boxes(encode_boxes(boxes, anchors), anchors), boxes)


def test_sizes_stay_finite_whatever_the_codes() -> None:
    anchor = torch.tensor([0.0, 0.0, 0.0, 3.9, 1.6, 1.5, 0.0])
    wild = decode_boxes(torch.tensor([0.0, 0.0, 0.0, 120.0, 7.0, 6.0, 0.0]), anchor)
    assert torch.isfinite(wild).all()
    torch.testing.assert_close(wild[3:6], anchor[3:6] * torch.tensor([1000.0, 1000.0, math.exp(6)]))


def test_direction_bins_of_known_headings() -> None:
    assert direction_bin(torch.tensor([0.1, 2.0, -2.0, 3.0])).tolist() == [1, 0, 1, 0]


def test_resolved_headings_of_known_cases() -> None:
    yaw = torch.tensor([0.1, 0.1, 2.0, 3.0], dtype=torch.float64)
    turned = resolve_heading(yaw, torch.tensor([0, 1, 0, 1]))
    expected = torch.tensor([3.24159 - 2 * math.pi, 0.1, 2.0, 6.14159 - 2 * math.pi], dtype=torch.float64)
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=0)


@given(st.floats(-20, 20))
def test_heading_survives_losing_its_half_turn(yaw: float) -> None:
    true = torch.tensor([yaw], dtype=torch.float64)
    found = resolve_heading(true + math.pi, direction_bin(true))
    assert math.isclose(math.cos(float(found) - yaw), 1.0, abs_tol=1e-6)
