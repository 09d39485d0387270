"""Whether two sets of detections are the same but for rounding, which may swap boxes of nearly equal score."""

from __future__ import annotations

import torch

from beambox.structures import Detections

__all__ = ["expect_same_boxes"]


def expect_same_boxes(found: Detections, wanted: Detections, tolerance: float, least: int = 6) -> None:
    """Compare scores in order, and each box with the nearest one, by which the two must pair up.

    Args:
        found: to be tested.
        wanted: what it should be.
        tolerance: of scores, metres and radians.
        least: number of detections below which the comparison says little.
    """
    assert len(found) == len(wanted) >= least
    torch.testing.assert_close(found.scores, wanted.scores, atol=tolerance, rtol=0)
    apart = (found.boxes[:, None] - wanted.boxes).abs().amax(dim=2)  # (N, N)
    near = apart.argmin(dim=1)
    assert sorted(near.tolist()) == list(range(len(wanted)))
    assert float(apart.amin(dim=1).max()) <= tolerance
    assert found.names == [wanted.names[k] for k in near.tolist()]
    torch.testing.assert_close(found.scores, wanted.scores[near], atol=tolerance, rtol=0)
