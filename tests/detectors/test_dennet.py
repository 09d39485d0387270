"""DenNet: sizes, switches, golden numbers of the network, learning."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors import voxel_rcnn as voxel_rcnn_module
from beambox.detectors.catalog import build, config_from_dict, config_to_dict
from beambox.detectors.dennet import (
    KITTI_005,
    KITTI_Z4,
    ONCE,
    AttentionPosition,
    CoordinateAttention,
    CountSet,
    DenNet,
    DenNetConfig,
    NeighborhoodBlock,
    Normalization,
    dennet,
)
from beambox.detectors.voxel_rcnn import VoxelRCNNConfig, voxel_rcnn
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.structures import Batch
from beambox.train.config import read_recipe
from oracles.learning import check_found, learn_by_heart, scan_with_cars
from oracles.scenes import scene
from oracles.small_detectors import CAR, DENNET, TWO_STAGES, build_small, car_frame

FULL = DenNetConfig()
OFF = {"vda": False, "na": False, "ca": False}


def size_of(config: DenNetConfig) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in dennet(config).parameters())


@pytest.mark.parametrize(
    ("config", "millions"),
    [
        (replace(FULL, **OFF), 7.600),
        (replace(FULL, na=False, ca=False), 7.661),
        (replace(FULL, ca=False), 7.869),
        (FULL, 7.874),
        (KITTI_Z4, 7.782),
        (KITTI_005, 7.874),
        (ONCE, 7.891),
        (replace(ONCE, **OFF), 7.617),
    ],
    ids=["baseline", "VDA", "VDA+NA", "full", "z4", "005", "ONCE", "ONCE-baseline"],
)
def test_parameters_of_each_setting(config: DenNetConfig, millions: float) -> None:
    assert size_of(config) == pytest.approx(millions * 1e6, abs=500)


def test_each_switch_removes_exactly_its_parameters() -> None:
    full = size_of(FULL)
    assert full - size_of(replace(FULL, vda=False)) == 14784 + 80 * 64 * 9  # the branch, and what reads its channels
    assert full - size_of(replace(FULL, na=False)) == 208118
    assert full - size_of(replace(FULL, ca=False)) == 5040
    perceptrons = sum(6 * c * c + (3 + 1) * c + 2 * c for c in (64, 128))
    assert full - size_of(replace(FULL, na_mlp=False)) == perceptrons
    for same in (
        {"na_position": AttentionPosition.MIDDLE},
        {"count_set": CountSet.POINTS},
        {"normalization": Normalization.RAW},
        {"max_count": 16},
    ):
        assert size_of(replace(FULL, **same)) == full


def test_without_its_parts_it_is_voxel_rcnn() -> None:
    plain = dennet(replace(DENNET, **OFF)).eval()
    other = voxel_rcnn(VoxelRCNNConfig(grid=DENNET.grid, pooling=DENNET.pooling, **TWO_STAGES)).eval()
    flat = {name.replace(".convolutions.", "."): value for name, value in plain.state_dict().items()}
    other.load_state_dict(flat)
    batch = Batch.of([car_frame(1, CAR)])
    with torch.inference_mode():
        ours, theirs = plain(batch), other(batch)
    torch.testing.assert_close(ours.first.cls, theirs.first.cls)
    torch.testing.assert_close(ours.refined.deltas, theirs.refined.deltas)


def test_the_defaults_are_the_papers_setting() -> None:
    assert FULL.grid.size == (704, 800, 40)
    assert KITTI_Z4.grid.size == (704, 800, 27)
    assert KITTI_005.grid.size == (1408, 1600, 40)
    assert ONCE.grid.size == (1504, 1504, 40)
    assert FULL.classes == ("Car", "Pedestrian", "Cyclist")
    assert ONCE.classes == ("Car", "Bus", "Truck", "Pedestrian", "Cyclist")
    assert FULL.radii == (0.6, 1.8)
    assert (FULL.na_window, FULL.na_heads, FULL.max_points) == (7, (2, 4), 5)
    with torch.device("meta"):
        first = [dennet(config).backbone.stages[0].convolutions[0][0].in_channels for config in (FULL, KITTI_Z4)]
    assert first == [256 + 80, 128 + 48]


@pytest.mark.parametrize(
    ("name", "config"),
    [
        (("dennet-kitti-3class",), FULL),
        (("dennet-kitti-3class", "detector.options.grid.maximum=[70.4, 40.0, 1.0]"), KITTI_Z4),
        (("dennet-kitti-3class-005",), KITTI_005),
        (("dennet-once",), ONCE),
        (("voxel_rcnn-once",), voxel_rcnn_module.ONCE),
    ],
)
def test_recipes_hold_the_named_settings(name: tuple[str, ...], config: VoxelRCNNConfig) -> None:
    recipe = read_recipe(name[0], name[1:])
    assert config_from_dict(type(config), recipe.detector.options) == config
    assert (recipe.optim.lr, recipe.optim.epochs, recipe.optim.batch) == (0.003, 100, 8)


@pytest.mark.parametrize(("position", "at"), [(AttentionPosition.END, 6), (AttentionPosition.MIDDLE, 3)])
def test_where_attention_stands_in_a_stage(position: AttentionPosition, at: int) -> None:
    with torch.device("meta"):
        stages = dennet(replace(FULL, na_position=position)).backbone.stages
    for stage, width, heads in zip(stages, (64, 128), (2, 4)):
        assert (len(stage.convolutions), len(stage.further)) == (at, 6 - at)
        assert isinstance(stage.na, NeighborhoodBlock) and isinstance(stage.ca, CoordinateAttention)
        assert stage.na.channels == width and stage.na.attention.heads == heads


def test_density_reaches_the_map_beside_the_encoders() -> None:
    small = build_small("dennet").eval()
    seen = {}
    small.backbone.register_forward_pre_hook(lambda _, inputs: seen.update(maps=inputs[0]))
    batch = Batch.of([car_frame(1, CAR), car_frame(2)])
    with torch.inference_mode():
        small(batch)
        points = small.voxels(batch, DENNET.grid)
    assert seen["maps"].shape == (2, 2 * 8 + 5 * 4, 8, 8)
    assert len(points) > 0 and bool(seen["maps"][:, 16:].any())


def test_options_are_read_as_plain_values() -> None:
    options = {**config_to_dict(DENNET), "count_set": "points", "na_position": "middle", "normalization": "log"}
    model = build("dennet", options)
    assert isinstance(model, DenNet)
    assert model.config.count_set is CountSet.POINTS and model.config.na_position is AttentionPosition.MIDDLE
    with pytest.raises(BeamboxError, match=r"`normalization`: .*'log-share', 'log', 'share' or 'raw', got 'sqrt'"):
        build("dennet", {"normalization": "sqrt"})


def test_wrong_options_are_refused() -> None:
    with pytest.raises(BeamboxError, match="`widths` has 2, `na_heads` has 1"):
        replace(DENNET, na_heads=(1,))
    with pytest.raises(BeamboxError, match="`na_window` must be odd, so that it has a centre, got 6"):
        replace(DENNET, na_window=6)


def test_learns_two_cars() -> None:
    grid = VoxelGrid((0.0, -20.8, -3.0), (46.4, 20.8, 3.0), (0.4, 0.4, 0.15))
    model = build_small("dennet", replace(DENNET, grid=grid))
    losses = learn_by_heart(model, scene(3, objects=2, per_object=120), 40, 0.01, clip=10)
    assert sum(losses[-5:]) / 5 < 0.35 * losses[0]


@pytest.mark.slow
def test_overfits_a_real_scan() -> None:
    grid = VoxelGrid((0.0, -19.2, -3.0), (38.4, 19.2, 3.0), (0.1, 0.1, 0.15))
    frame = scan_with_cars(grid)
    config = DenNetConfig(anchors=KITTI_ANCHORS[:1], grid=grid, depths=(1, 1), dropout=0.0, centered_anchors=True)
    model = build_small("dennet", config)
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            module.momentum = 0.1  # the statistics must settle within these few steps
    losses = learn_by_heart(model, frame, 120, 0.003, clip=10)
    assert losses[-1] < 0.15 * losses[0]
    with torch.inference_mode():
        (found,) = model.eval().decode(model(Batch.of([frame])))
    check_found(found.boxes, frame.labels.boxes)
