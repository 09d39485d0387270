"""DenNet: sizes, switches, golden numbers of the network, learning."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.kitti import KittiSource
from beambox.detectors import voxel_rcnn as voxel_rcnn_module
from beambox.detectors.catalogue import build, config_from_dict, config_to_dict
from beambox.detectors.dennet import (
    KITTI_005,
    KITTI_Z4,
    ONCE,
    AttentionPosition,
    DenNet,
    DenNetConfig,
    dennet,
)
from beambox.detectors.voxel_rcnn import VoxelRcnnConfig, voxel_rcnn
from beambox.detectors.weights import load_weights, save_weights
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.layers.coordinate_attention import CoordinateAttention
from beambox.layers.density import CountSet, Normalisation
from beambox.layers.neighborhood_block import NeighborhoodBlock
from beambox.layers.roi import ProposalLimits, RoiSampling
from beambox.structures import Batch, Frame, Labels
from beambox.train.config import read_recipe
from oracles.paths import ROOT, data_dir
from oracles.scenes import scene

FULL = DenNetConfig()
SMALL_PARTS: dict[str, Any] = {
    "anchors": KITTI_ANCHORS[:1],
    "encoder_widths": (4, 4, 8, 8),
    "encoder_out": 8,
    "depths": (1, 1),
    "widths": (8, 8),
    "up_widths": (8, 8),
    "train_proposals": ProposalLimits(200, 20, 0.8),
    "test_proposals": ProposalLimits(100, 10, 0.7),
    "sampling": RoiSampling(per_sample=8),
    "lattice": 2,
    "roi_width": 16,
}
SMALL = DenNetConfig(
    grid=VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 3.0), (0.2, 0.2, 0.15)),
    density_depth=4,
    na_heads=(1, 2),
    **SMALL_PARTS,
)
OFF = {"vda": False, "na": False, "ca": False}


def sweep(seed: int, points: int = 400) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.rand((points, 4), generator=generator) * torch.tensor([12.0, 12.0, 2.5, 1.0])
    labels = Labels(torch.tensor([[6.0, 0, -1, 4, 1.6, 1.5, 0.3]]), ("Car",))
    return Frame(xyz - torch.tensor([0.0, 6.0, 2.5, 0.0]), labels=labels)


@pytest.fixture
def small() -> DenNet:
    torch.manual_seed(0)
    return dennet(SMALL)


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
        {"normalisation": Normalisation.RAW},
        {"max_count": 16},
    ):
        assert size_of(replace(FULL, **same)) == full


def test_without_its_parts_it_is_voxel_rcnn() -> None:
    plain = dennet(replace(SMALL, **OFF)).eval()
    other = voxel_rcnn(VoxelRcnnConfig(grid=SMALL.grid, pooling=SMALL.pooling, **SMALL_PARTS)).eval()
    other.load_state_dict(plain.state_dict())
    batch = Batch.of([sweep(1)])
    with torch.inference_mode():
        ours, theirs = plain(batch), other(batch)
    torch.testing.assert_close(ours.first.cls, theirs.first.cls)
    assert ours.refined is not None and theirs.refined is not None
    torch.testing.assert_close(ours.refined.codes, theirs.refined.codes)


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
        first = [dennet(config).backbone.stages[0][0][0].in_channels for config in (FULL, KITTI_Z4)]
    assert first == [256 + 80, 128 + 48]


@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("dennet_kitti", FULL),
        ("dennet_kitti_z4", KITTI_Z4),
        ("dennet_kitti_005", KITTI_005),
        ("dennet_once", ONCE),
        ("voxelrcnn_once", voxel_rcnn_module.ONCE),
    ],
)
def test_recipes_hold_the_named_settings(name: str, config: VoxelRcnnConfig) -> None:
    recipe = read_recipe(ROOT / "recipes" / f"{name}.yaml")
    assert config_from_dict(type(config), recipe.detector.options) == config
    assert (recipe.optim.lr, recipe.optim.epochs, recipe.optim.batch) == (0.003, 100, 8)


@pytest.mark.parametrize(("position", "at"), [(AttentionPosition.END, 6), (AttentionPosition.MIDDLE, 3)])
def test_where_attention_stands_in_a_stage(position: AttentionPosition, at: int) -> None:
    with torch.device("meta"):
        stages = dennet(replace(FULL, na_position=position)).backbone.stages
    for stage, width, heads in zip(stages, (64, 128), (2, 4)):
        kinds = [type(layer) for layer in stage]
        assert len(kinds) == 8
        assert kinds.index(NeighborhoodBlock) == at
        assert kinds.index(CoordinateAttention) == 7
        assert stage[at].channels == width and stage[at].attention.heads == heads


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"na_position": AttentionPosition.MIDDLE, "na_mlp": False, "count_set": CountSet.POINTS, "own_points": True},
        {"normalisation": Normalisation.SHARE, "max_count": 16, "density_collapse": True, "na": False},
    ],
    ids=["published", "middle-points", "share-collapsed-no-NA"],
)
def test_losses_of_both_stages_reach_every_parameter(options: dict[str, Any]) -> None:
    torch.manual_seed(0)
    model = dennet(replace(SMALL, **options))
    batch = Batch.of([sweep(1), sweep(2)])
    losses = model.loss(model(batch), batch.labels, torch.Generator().manual_seed(0))
    assert set(losses) == {"cls", "loc", "direction", "roi_cls", "roi_box", "roi_corner"}
    torch.stack(list(losses.values())).sum().backward()
    unfed = [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.isfinite().all())]
    assert unfed == []


def test_density_reaches_the_map_beside_the_encoders(small: DenNet) -> None:
    small.eval()
    seen = {}
    small.backbone.register_forward_pre_hook(lambda _, inputs: seen.update(maps=inputs[0]))
    batch = Batch.of([sweep(1), sweep(2)])
    with torch.inference_mode():
        small(batch)
        points = small.voxels(batch, SMALL.grid)
    assert seen["maps"].shape == (2, 2 * 8 + 5 * 4, 8, 8)
    assert len(points) > 0 and bool(seen["maps"][:, 16:].any())


def test_samples_of_a_batch_do_not_touch_each_other(small: DenNet) -> None:
    small.eval()
    with torch.inference_mode():
        both, alone = small(Batch.of([sweep(1), sweep(2)])), small(Batch.of([sweep(2)]))
    torch.testing.assert_close(both.first.cls[1:], alone.first.cls, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("training", [True, False])
def test_sweeps_without_points(small: DenNet, training: bool) -> None:
    small.train(training)
    empty = Frame(torch.zeros(0, 4), labels=Labels.empty())
    predictions = small(Batch.of([empty, empty]))
    assert len(small.decode(predictions)) == 2
    losses = small.loss(predictions, [Labels.empty()] * 2)
    assert all(bool(torch.isfinite(v)) for v in losses.values())


def test_another_region(small: DenNet) -> None:
    small.eval()
    with torch.inference_mode():
        predictions = small(Batch.of([sweep(1)]), SMALL.grid.window((0, 8), (40, 24)))
    assert predictions.first.cls.shape == (1, 5 * 3 * 2, 1), "a map lower than the window of 7 is padded"


def test_is_built_by_name_and_survives_a_weight_file(tmp_path, small: DenNet) -> None:
    options = {**config_to_dict(SMALL), "count_set": "points", "na_position": "middle", "normalisation": "log"}
    model = build("dennet", options)
    assert isinstance(model, DenNet)
    assert model.config.count_set is CountSet.POINTS and model.config.na_position is AttentionPosition.MIDDLE
    save_weights(tmp_path / "w.safetensors", model)
    again = load_weights(tmp_path / "w.safetensors")
    assert type(again) is DenNet and again.config == model.config
    batch = Batch.of([sweep(1)])
    with torch.inference_mode():
        torch.testing.assert_close(again(batch).first.cls, model.eval()(batch).first.cls)
    with pytest.raises(BeamboxError, match=r"`normalisation`: .*'log-share', 'log', 'share' or 'raw', got 'sqrt'"):
        build("dennet", {"normalisation": "sqrt"})


def test_wrong_options_are_refused() -> None:
    with pytest.raises(BeamboxError, match="`widths` has 2, `na_heads` has 1"):
        replace(SMALL, na_heads=(1,))
    with pytest.raises(BeamboxError, match="`na_window` must be odd, so that it has a centre, got 6"):
        replace(SMALL, na_window=6)


def overfit(model: DenNet, batch: Batch, steps: int, lr: float) -> list[float]:
    """Repeat one batch; dropout and random regions stay on."""
    assert batch.labels is not None
    optimiser = torch.optim.Adam(model.train().parameters(), lr=lr)
    draw = torch.Generator().manual_seed(0)
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        total = torch.stack(list(model.loss(model(batch), batch.labels, draw).values())).sum()
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10)
        optimiser.step()
        losses.append(float(total.detach()))
    return losses


def test_learns_two_cars() -> None:
    torch.manual_seed(0)
    frame = scene(3, objects=2, per_object=120)
    grid = VoxelGrid((0.0, -20.8, -3.0), (46.4, 20.8, 3.0), (0.4, 0.4, 0.15))
    model = dennet(replace(SMALL, grid=grid))
    losses = overfit(model, Batch.of([frame]), 40, 0.01)
    assert sum(losses[-5:]) / 5 < 0.35 * losses[0]


@pytest.mark.slow
def test_overfits_a_real_scan() -> None:
    source = KittiSource(data_dir("kitti"), "train", fov=True)
    grid = VoxelGrid((0.0, -19.2, -3.0), (38.4, 19.2, 3.0), (0.1, 0.1, 0.15))
    frame = next(f for f in source if f.labels is not None and len(near_cars(f.labels, grid)) >= 4)
    labels = near_cars(frame.labels, grid)
    torch.manual_seed(0)
    config = DenNetConfig(anchors=KITTI_ANCHORS[:1], grid=grid, depths=(1, 1), dropout=0.0, centred_anchors=True)
    model = dennet(config)
    batch = Batch.of([replace(frame, labels=labels)])
    losses = overfit(model, batch, 120, 0.003)
    assert losses[-1] < 0.15 * losses[0]
    with torch.inference_mode():
        (found,) = model.eval().decode(model(batch))
    distance = torch.cdist(found.boxes[:, :2], labels.boxes[:, :2])
    assert float(distance.amin(dim=0).max()) < 0.5, "every labelled car is found"
    assert float(distance.amin(dim=1).max()) < 0.5, "nothing else is found"


def near_cars(labels: Labels, grid: VoxelGrid) -> Labels:
    of_cars = labels.of_classes(("Car",))
    return of_cars[grid.contains(of_cars.boxes)]
