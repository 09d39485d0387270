from dataclasses import replace

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build, config_from_dict
from beambox.detectors.hcnet import HCNET_CAR, Gate, HCNetConfig, HeightChannelKind, hcnet, pseudo_images
from beambox.geometry.grid import VoxelGrid
from beambox.ops.voxelize import voxelize
from beambox.structures import Batch
from beambox.train.config import read_recipe
from oracles.learning import check_found, learn_by_heart, scan_with_cars
from oracles.small_detectors import CAR, HCNET, build_small, car_frame

PLAIN = replace(HCNET, oifm=False, aam=False)


def size_of(config: HCNetConfig) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in hcnet(config).parameters())


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
    assert (car.size, car.matched_threshold, car.unmatched_threshold) == ((3.9, 1.6, 1.5), 0.6, 0.45)
    assert (config.loss.loc, config.loss.cls, config.loss.direction) == (2.0, 1.0, 0.2)


def test_the_papers_recipe_is_the_defaults() -> None:
    recipe = read_recipe("hcnet-kitti-car")
    assert config_from_dict(HCNetConfig, recipe.detector.options) == HCNetConfig()


def test_the_network_merges_pseudo_images_as_the_paper_writes_it() -> None:
    model = build_small("hcnet").eval()
    for parameter in model.fuse_slices.parameters():
        torch.nn.init.normal_(parameter)
    batch = Batch.of([car_frame(1, CAR, ground=1500, reach=20.0), car_frame(2)])
    seen = {}
    model.backbone.register_forward_pre_hook(lambda _, inputs: seen.update(image=inputs[0]))
    model(batch)
    voxels = voxelize(batch.points, batch.sample, 2, HCNET.grid, HCNET.max_points, HCNET.max_voxels)
    images = pseudo_images(model.voxel_net(voxels), voxels)
    assert images.shape == (2, 8, 64, 64, 4)
    torch.testing.assert_close(seen["image"], model.fuse_slices.dense(images), atol=1e-6, rtol=1e-6)


@pytest.mark.slow
def test_overfits_a_real_scan() -> None:
    grid = VoxelGrid((0, -20.48, -3), (40.96, 20.48, 1), (0.32, 0.32, 1))
    frame = scan_with_cars(grid)
    model = build_small(
        "hcnet",
        replace(HCNET, grid=grid, voxel_channels=32, widths=(32, 32, 64), up_widths=(32, 32, 32), head_width=32),
    )
    losses = learn_by_heart(model, frame, 150, 0.003)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(Batch.of([frame])))
    check_found(found[found.scores > 0.5].boxes.detach(), frame.labels.boxes)


def test_without_global_weights_a_window_agrees_with_the_whole_far_from_its_border() -> None:
    torch.manual_seed(0)
    model = hcnet(PLAIN).eval()
    batch = Batch.of([car_frame(2, [10, 0, -1, 4.0, 1.7, 1.5, 0.0], ground=1500, reach=20.0)])
    whole = model(batch)
    part = model(batch, HCNET.grid.window((0, 0), (64, 56)))
    assert part.anchors.shape == (28 * 32 * 2, 7)
    torch.testing.assert_close(part.anchors, whole.anchors[: 28 * 32 * 2])
    torch.testing.assert_close(
        part.cls.reshape(1, 28, 32, -1)[:, :4], whole.cls.reshape(1, 32, 32, -1)[:, :4], atol=1e-4, rtol=1e-3
    )


def test_a_map_of_odd_size_works() -> None:
    model = build_small("hcnet").eval()
    batch = Batch.of([car_frame(2, [10, 0, -1, 4.0, 1.7, 1.5, 0.0], ground=1500, reach=20.0)])
    predictions = model(batch, HCNET.grid.window((0, 0), (37, 45)))
    assert predictions.cls.shape == (1, 23 * 19 * 2, 1)
    assert len(predictions.anchors) == 23 * 19 * 2


def test_a_region_with_other_slices_is_refused() -> None:
    model = build_small("hcnet").eval()
    flat = VoxelGrid(HCNET.grid.minimum, HCNET.grid.maximum, (0.32, 0.32, 4))
    with pytest.raises(BeamboxError, match="`grid` must have the 4 height slices of the network, got 1"):
        model(Batch.of([car_frame(1)]), flat)


def test_a_wrong_number_of_stages_is_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`widths` must have 3 entries, one per stage, got 2: \[8, 8\]"):
        replace(HCNET, widths=(8, 8))
    with pytest.raises(BeamboxError, match="`anchors` must name at least one class"):
        replace(HCNET, anchors=())


def test_a_wrong_attention_is_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`attention`: .*'none', 'CA', 'HA' or 'HCA', got 'both'"):
        build("hcnet", {"attention": "both"})


def test_car_anchor_stands_on_the_ground_of_kitti() -> None:
    assert HCNET_CAR.bottom_z + HCNET_CAR.size[2] / 2 == pytest.approx(-1.03)
