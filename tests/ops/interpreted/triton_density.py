"""The Triton kernel of ball counts, on a GPU or through Triton's interpreter (see test_triton.py)."""

import pytest
import torch

from beambox.ops.ball_count import ball_count, ball_counts, reference

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.mark.parametrize(("count", "levels"), [(1, 5), (100, 40), (60, 130)])
@pytest.mark.parametrize("radius", [0.15, 0.3])
def test_ball_count_equals_reference(count, levels, radius):
    generator = torch.Generator().manual_seed(count)
    sizes = (2, levels, 12, 12)
    index = torch.stack([torch.randint(0, size, (count,), generator=generator) for size in sizes], dim=1).to(DEVICE)
    index[:, 1] -= 7
    actual = ball_count(index, (0.1, 0.1, 0.15), radius)
    assert actual.tolist() == reference.ball_count(index, (0.1, 0.1, 0.15), radius).tolist()


def test_ball_count_of_full_columns():
    z = torch.arange(64, device=DEVICE)
    index = torch.stack((z * 0, z, z * 0, z * 0), dim=1)
    assert ball_count(index, (1.0, 1.0, 0.01), 0.9).tolist() == [64] * 64


def test_several_radii_with_known_extent_and_voxels_that_stand_twice():
    index = torch.tensor([[0, 0, 0, 0], [1, 70, 3, 4], [1, 69, 3, 4], [1, 70, 3, 4], [1, 70, 5, 4]], device=DEVICE)
    actual = ball_counts(index, (0.1, 0.2, 0.3), (0.35, 0.5), (2, 71, 6, 5))
    assert actual.equal(reference.ball_counts(index, (0.1, 0.2, 0.3), (0.35, 0.5)))
    assert actual.tolist() == [[1, 1], [2, 3], [2, 3], [2, 3], [1, 3]]  # 0.3 up, 0.4 aside, 0.5 both
