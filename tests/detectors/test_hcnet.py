import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.kitti import KittiSource
from beambox.detectors.catalogue import build, config_from_dict, config_to_dict
from beambox.detectors.hcnet import HCNET_CAR, HCNetConfig, hcnet
from beambox.detectors.weights import load_weights, save_weights
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.layers.attention import Gate, HeightChannelKind, pseudo_images
from beambox.ops.voxelize import voxelize
from beambox.structures import Batch, Frame, Labels
from beambox.train.config import read_recipe
from oracles.paths import data_dir

SMALL = HCNetConfig(
    grid=VoxelGrid((0, -10.24, -3), (20.48, 10.24, 1), (0.32, 0.32, 1)),
    voxel_channels=8,
    channel_hidden=4,
    depths=(1, 1, 1),
    widths=(8, 8, 16),
    up_widths=(8, 8, 8),
    head_depth=1,
    head_width=16,
    oifm_width=8,
    centred_anchors=True,
)
PLAIN = replace(SMALL, oifm=False, aam=False)


def car_frame(seed: int, *boxes: list[float]) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    ground = torch.rand(1500, 4, generator=generator) * torch.tensor([20.0, 20.0, 0.05, 0.3])
    ground -= torch.tensor([0.0, 10.0, 1.75, 0.0])
    clouds = [ground]
    for x, y, z, length, width, height, yaw in boxes:
        local = (torch.rand(300, 3, generator=generator) - 0.5) * torch.tensor([length, width, height])
        face = torch.randint(0, 2, (300,), generator=generator)
        local[face == 0, 0] = -length / 2
        local[face == 1, 1] = -width / 2
        cos, sin = math.cos(yaw), math.sin(yaw)
        xyz = torch.stack(
            (x + cos * local[:, 0] - sin * local[:, 1], y + sin * local[:, 0] + cos * local[:, 1], z + local[:, 2]), 1
        )
        clouds.append(torch.cat((xyz, torch.full((300, 1), 0.5)), dim=1))
    labels = Labels(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 7), ("Car",) * len(boxes))
    return Frame(torch.cat(clouds), id=str(seed), labels=labels)


def size_of(config: HCNetConfig) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in hcnet(config).parameters())


def overfit(model: torch.nn.Module, batch: Batch, steps: int, lr: float) -> list[float]:
    assert batch.labels is not None
    optimiser = torch.optim.Adam(model.train().parameters(), lr=lr)
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        total = torch.stack(list(model.loss(model(batch), batch.labels).values())).sum()
        total.backward()
        optimiser.step()
        losses.append(float(total.detach()))
    return losses


def test_each_switch_removes_its_parameters() -> None:
    full = HCNetConfig()
    assert size_of(full) == 7_104_596
    assert size_of(replace(full, oifm=False)) == pytest.approx(6.808e6, rel=1e-3)
    assert size_of(replace(full, aam=False)) == pytest.approx(6.710e6, rel=1e-3)
    attention = {kind: size_of(replace(full, attention=kind)) for kind in HeightChannelKind}
    height, channel = 40, 2128
    bare = attention[HeightChannelKind.NONE]
    assert attention[HeightChannelKind.HEIGHT] == bare + height
    assert attention[HeightChannelKind.CHANNEL] == bare + channel
    assert attention[HeightChannelKind.BOTH] == bare + height + channel == size_of(full)
    assert size_of(replace(full, aam_gate=Gate.SIGMOID)) == size_of(full)


def test_the_defaults_are_the_papers_setting() -> None:
    config = HCNetConfig()
    assert config.grid.size == (432, 496, 4)
    assert config.classes == ("Car",)
    (car,) = config.anchors
    assert (car.size, car.matched, car.unmatched) == ((3.9, 1.6, 1.5), 0.6, 0.45)
    assert (config.loss.loc, config.loss.cls, config.loss.direction) == (2.0, 1.0, 0.2)


def test_the_papers_recipe_is_the_defaults() -> None:
    recipe = read_recipe(Path(__file__).resolve().parents[2] / "recipes" / "hcnet_kitti_car.yaml")
    assert config_from_dict(HCNetConfig, recipe.detector.options) == HCNetConfig()


def test_the_network_merges_pseudo_images_as_the_paper_writes_it() -> None:
    torch.manual_seed(0)
    model = hcnet(SMALL).eval()
    for parameter in model.fuse_slices.parameters():
        torch.nn.init.normal_(parameter)
    batch = Batch.of([car_frame(1, [6, 2, -1, 4.0, 1.7, 1.5, 0.4]), car_frame(2)])
    seen = {}
    model.backbone.register_forward_pre_hook(lambda _, inputs: seen.update(image=inputs[0]))
    model(batch)
    voxels = voxelize(batch.points, batch.sample, 2, SMALL.grid, SMALL.max_points, SMALL.max_voxels)
    images = pseudo_images(model.voxel_net(voxels), voxels)
    assert images.shape == (2, 8, 64, 64, 4)
    torch.testing.assert_close(seen["image"], model.fuse_slices.dense(images), atol=1e-6, rtol=1e-6)


def test_overfits_two_cars_and_finds_them() -> None:
    torch.manual_seed(0)
    frame = car_frame(1, [6, 2, -1, 4.0, 1.7, 1.5, 0.4], [13, -4, -1, 3.7, 1.6, 1.5, -2.0])
    model = hcnet(SMALL)
    batch = Batch.of([frame])
    losses = overfit(model, batch, 80, 0.01)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(batch))
    best = found[:2]
    order = best.boxes[:, 0].argsort()
    torch.testing.assert_close(best.boxes[order][:, :2].detach(), frame.labels.boxes[:, :2], atol=0.3, rtol=0)
    heading = best.boxes[order][:, 6].detach() - frame.labels.boxes[:, 6]
    assert bool((torch.cos(heading) > 0.9).all())


@pytest.mark.slow
def test_overfits_a_real_scan() -> None:
    source = KittiSource(data_dir("kitti"), "train", fov=True)
    grid = VoxelGrid((0, -20.48, -3), (40.96, 20.48, 1), (0.32, 0.32, 1))
    cars = next(f for f in source if f.labels is not None and len(near_cars(f.labels, grid)) >= 4)
    labels = near_cars(cars.labels, grid)
    frame = replace(cars, labels=labels)
    torch.manual_seed(0)
    config = replace(SMALL, grid=grid, voxel_channels=32, widths=(32, 32, 64), up_widths=(32, 32, 32), head_width=32)
    model = hcnet(config)
    batch = Batch.of([frame])
    losses = overfit(model, batch, 150, 0.003)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(batch))
    confident = found[found.scores > 0.5]
    distance = torch.cdist(confident.boxes[:, :2].detach(), labels.boxes[:, :2])
    assert float(distance.amin(dim=0).max()) < 0.5, "every labelled car is found"
    assert float(distance.amin(dim=1).max()) < 0.5, "nothing else is found"


def near_cars(labels: Labels, grid: VoxelGrid) -> Labels:
    of_cars = labels.of_classes(("Car",))
    return of_cars[grid.contains(of_cars.boxes)]


def test_without_global_weights_a_window_agrees_with_the_whole_far_from_its_border() -> None:
    torch.manual_seed(0)
    model = hcnet(PLAIN).eval()
    batch = Batch.of([car_frame(2, [10, 0, -1, 4.0, 1.7, 1.5, 0.0])])
    whole = model(batch)
    part = model(batch, SMALL.grid.window((0, 0), (64, 56)))
    assert part.anchors.shape == (28 * 32 * 2, 7)
    torch.testing.assert_close(part.anchors, whole.anchors[: 28 * 32 * 2])
    torch.testing.assert_close(
        part.cls.reshape(1, 28, 32, -1)[:, :4], whole.cls.reshape(1, 32, 32, -1)[:, :4], atol=1e-4, rtol=1e-3
    )


def test_a_map_of_odd_size_works() -> None:
    model = hcnet(SMALL).eval()
    batch = Batch.of([car_frame(2, [10, 0, -1, 4.0, 1.7, 1.5, 0.0])])
    predictions = model(batch, SMALL.grid.window((0, 0), (37, 45)))
    assert predictions.cls.shape == (1, 23 * 19 * 2, 1)
    assert len(predictions.anchors) == 23 * 19 * 2


def test_a_region_with_other_slices_is_refused() -> None:
    model = hcnet(SMALL).eval()
    flat = VoxelGrid(SMALL.grid.minimum, SMALL.grid.maximum, (0.32, 0.32, 4))
    with pytest.raises(BeamboxError, match="`grid` must have the 4 height slices of the network, got 1"):
        model(Batch.of([car_frame(1)]), flat)


def test_a_wrong_number_of_stages_is_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`widths` must have 3 entries, one a stage, got 2: \[8, 8\]"):
        replace(SMALL, widths=(8, 8))
    with pytest.raises(BeamboxError, match="`anchors` must name at least one class"):
        replace(SMALL, anchors=())


def test_samples_of_a_batch_do_not_touch_each_other() -> None:
    torch.manual_seed(0)
    model = hcnet(SMALL).eval()
    one, two = car_frame(3, [10, 0, -1, 4.0, 1.7, 1.5, 0.0]), car_frame(4)
    alone = model(Batch.of([two]))
    joined = model(Batch.of([one, two]))
    torch.testing.assert_close(joined.cls[1], alone.cls[0], atol=1e-5, rtol=1e-4)


def test_an_empty_sweep_gives_predictions_a_loss_and_no_error() -> None:
    model = hcnet(SMALL)
    batch = Batch.of([Frame(torch.zeros(0, 4), labels=Labels.empty())])
    assert batch.labels is not None
    for mode in (True, False):
        model.train(mode)
        losses = model.loss(model(batch), batch.labels)
        assert all(torch.isfinite(v) for v in losses.values())
    assert len(model.decode(model(batch))) == 1


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        replace(SMALL, attention=HeightChannelKind.HEIGHT, oifm=False),
        replace(SMALL, attention=HeightChannelKind.CHANNEL, aam_gate=Gate.SIGMOID),
        replace(SMALL, attention=HeightChannelKind.NONE, aam=False, absolute_xy=False),
        replace(SMALL, grid=VoxelGrid((0, -10.24, -3), (20.48, 10.24, 1), (0.32, 0.32, 0.5)), anchors=KITTI_ANCHORS),
    ],
    ids=["full", "HA-no-oifm", "CA-sigmoid", "plain", "8-slices-3-classes"],
)
def test_every_parameter_receives_a_gradient(config: HCNetConfig) -> None:
    torch.manual_seed(0)
    model = hcnet(config)
    for name, parameter in model.fuse_slices.named_parameters():
        if name.endswith("bias"):
            torch.nn.init.constant_(parameter, 0.5)  # so that no ReLU of the attention is shut from the start
    batch = Batch.of([car_frame(5, [6, 2, -1, 4.0, 1.7, 1.5, 0.4])])
    assert batch.labels is not None
    torch.stack(list(model.loss(model(batch), batch.labels).values())).sum().backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.any())] == []


def test_is_built_by_name_and_survives_a_weight_file(tmp_path) -> None:
    options = {**config_to_dict(SMALL), "attention": "HA", "aam_gate": "sigmoid", "oifm": False}
    model = build("hcnet", options)
    assert model.config.attention is HeightChannelKind.HEIGHT and model.config.aam_gate is Gate.SIGMOID
    save_weights(tmp_path / "w.safetensors", model)
    again = load_weights(tmp_path / "w.safetensors")
    assert again.config == model.config
    batch = Batch.of([car_frame(1)])
    torch.testing.assert_close(again(batch).cls, model.eval()(batch).cls)
    with pytest.raises(BeamboxError, match=r"`attention`: .*'none', 'CA', 'HA' or 'HCA', got 'both'"):
        build("hcnet", {"attention": "both"})


def test_car_anchor_stands_on_the_ground_of_kitti() -> None:
    assert HCNET_CAR.bottom + HCNET_CAR.size[2] / 2 == pytest.approx(-1.03)
