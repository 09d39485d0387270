"""The histogram of points per voxel."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from beambox.checks import BeamboxError
from beambox.cli.data import app
from beambox.data.kitti import KittiSource
from beambox.structures import Frame
from beambox.visualize.voxel_histogram import BAR, draw_histogram, points_per_voxel, voxel_histogram
from oracles.own_data import write_pandaset
from oracles.paths import data_dir

CELL = (0.1, 0.1, 0.2)


def test_points_are_counted_voxel_by_voxel() -> None:
    points = torch.tensor([[0.05, 0.05, 0.1], [0.01, 0.09, 0.19], [-0.05, 0.05, 0.1], [0.05, 0.05, -0.1]])
    assert sorted(points_per_voxel(points, CELL).tolist()) == [1, 1, 2]
    points = torch.rand((3000, 4), generator=torch.Generator().manual_seed(0)) - 0.5
    points[:2] = torch.tensor([[torch.nan], [1e9]])
    whole = torch.floor(points[1:, :3].double() / torch.tensor(CELL, dtype=torch.float64)).unique(
        dim=0, return_counts=True
    )
    assert sorted(points_per_voxel(points, CELL).tolist()) == sorted(whole[1].tolist())
    with pytest.raises(BeamboxError, match="`cell` must be three lengths above 0"):
        points_per_voxel(points, (0.1, 0.0, 0.2))


def test_the_last_bar_gathers_the_rest() -> None:
    one = torch.tensor([[0.05, 0.05, 0.1, 0.0]])
    frames = [Frame(one), Frame(one.expand(7, 4)), Frame(torch.zeros(0, 4))]
    histogram = voxel_histogram(frames, CELL, most=3)
    assert histogram.voxels == (1, 0, 1)
    assert histogram.shares() == (0.5, 0.0, 0.5)
    assert histogram.frames == 3
    assert histogram.table().splitlines() == [
        "2 occupied voxels of 0.1 x 0.1 x 0.2 m in 3 sweeps",
        "points   voxels",
        f"     1   50.00 %  {'#' * 25}",
        "     2    0.00 %",
        f"    3+   50.00 %  {'#' * 25}",
    ]


def test_nothing_at_all() -> None:
    histogram = voxel_histogram([], CELL)
    assert histogram.shares() == (0.0,) * 10
    assert draw_histogram(histogram).size == (750, 600)


def test_bars_grow_with_their_shares() -> None:
    """Three voxels of one point and one of two: the first bar is three times as high as the second."""
    points = torch.tensor([[0.05 + x, 0.05, 0.1, 0.0] for x in (0, 1, 2, 3, 3)])
    picture = draw_histogram(voxel_histogram([Frame(points)], CELL, most=2), title="KITTI")
    blue = (torch.tensor(list(picture.tobytes())).view(600, 750, 3) == torch.tensor(BAR)).all(dim=2)
    columns = blue.sum(dim=0)
    first, second = columns[90:410].max(), columns[410:].max()
    assert 440 < first <= 451
    assert abs(first - 3 * second) <= 3


def test_real_voxels_hold_one_or_two_points() -> None:
    source = KittiSource(data_dir("kitti"), "full")
    shares = voxel_histogram([source[0]], (0.1, 0.1, 0.15)).shares()
    assert shares[0] > 0.4 and sum(shares[:2]) > 0.6, "the claim of DenNet's figure 2"


def test_the_command_counts_and_draws(tmp_path: Path) -> None:
    data, out = write_pandaset(tmp_path, frames=1), tmp_path / "figure.png"
    done = CliRunner().invoke(app, ["voxels", str(data), "--cell", "0.1,0.1,0.2", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "occupied voxels of 0.1 x 0.1 x 0.2 m in 1 sweeps" in done.output
    assert Image.open(out).size == (750, 600)
    wrong = CliRunner().invoke(app, ["voxels", str(data), "--cell", "0.1,0.1"])
    assert wrong.exit_code == 2
    assert '--cell takes three lengths in metres, as 0.1,0.1,0.15; got "0.1,0.1"' in wrong.output
