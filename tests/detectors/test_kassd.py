import math
from dataclasses import replace

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.data.kitti import KittiSource
from beambox.detectors.catalogue import build, config_to_dict
from beambox.detectors.kassd import KamOptions, KamScore, Kassd, KassdConfig, KassdPredictions, Neck, kassd
from beambox.detectors.second import KITTI_CAR, second
from beambox.detectors.weights import load_weights, save_weights
from beambox.geometry.boxes import wrap_angle
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.layers.heads import LossWeights
from beambox.layers.keypoints import ExtraPoint, KeypointLayout
from beambox.layers.location_attention import LamReduce
from beambox.structures import Batch, Frame, Labels
from oracles.paths import data_dir

SMALL = KassdConfig(
    grid=VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 1.0), (0.1, 0.1, 0.1)),
    encoder_widths=(4, 4, 8, 8),
    encoder_out=8,
    width=8,
    kam_width=8,
    centred_anchors=True,
)
CAR = [6.0, 1.0, -1.0, 4.0, 1.7, 1.5, 0.4]


def car_frame(seed: int, *boxes: list[float]) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    ground = torch.rand(800, 4, generator=generator) * torch.tensor([12.0, 12.0, 0.05, 0.3])
    clouds = [ground - torch.tensor([0.0, 6.0, 1.75, 0.0])]
    for x, y, z, length, width, height, yaw in boxes:
        local = (torch.rand(300, 3, generator=generator) - 0.5) * torch.tensor([length, width, height])
        face = torch.randint(0, 2, (300,), generator=generator)
        local[face == 0, 0] = -length / 2
        local[face == 1, 1] = -width / 2
        turn = torch.polar(torch.ones(()), torch.tensor(yaw)) * torch.complex(local[:, 0], local[:, 1])
        xyz = torch.stack((x + turn.real, y + turn.imag, z + local[:, 2]), dim=1)
        clouds.append(torch.cat((xyz, torch.full((300, 1), 0.5)), dim=1))
    labels = Labels(torch.tensor(boxes, dtype=torch.float32).reshape(-1, 7), ("Car",) * len(boxes))
    return Frame(torch.cat(clouds), id=str(seed), labels=labels)


def size_of(config: KassdConfig) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in kassd(config).parameters())


def total(losses: dict[str, torch.Tensor]) -> torch.Tensor:
    return torch.stack(list(losses.values())).sum()


def overfit(model: Kassd, batch: Batch, steps: int, lr: float) -> list[float]:
    assert batch.labels is not None
    optimiser = torch.optim.Adam(model.train().parameters(), lr=lr)
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        loss = total(model.loss(model(batch), batch.labels))
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    return losses


def test_each_switch_has_the_parameters_of_its_parts() -> None:
    full = KassdConfig()
    assert size_of(full) == 3_556_467
    assert size_of(replace(full, llm=False, kam=False)) == 5_298_900
    assert size_of(replace(full, kam=False)) == 3_257_044
    assert size_of(replace(full, llm=False)) == size_of(replace(full, neck=Neck.SECOND)) == 6_040_691
    for free in (replace(full, frs_reuse=False), replace(full, lam=False), replace(full, lam_reduce=LamReduce.MEAN)):
        assert size_of(free) == size_of(full)
    of_neck = {neck: size_of(replace(full, neck=neck)) for neck in Neck}
    assert of_neck == {
        Neck.LLM: 3_556_467,
        Neck.SECOND: 6_040_691,
        Neck.PSA: 8_789_619,
        Neck.DENSEASPP: 4_099_443,
        Neck.SPP: 3_819_123,
    }
    fewer = replace(full, keypoints=KeypointLayout(m=2, n=2, d=0, e=0))
    assert size_of(full) - size_of(fewer) == (31 - 4) * 129


def test_the_baseline_is_second() -> None:
    with torch.device("meta"):
        ours, theirs = kassd(KassdConfig(llm=False, kam=False)), second(KITTI_CAR)
    assert [p.shape for p in ours.parameters()] == [p.shape for p in theirs.parameters()]


def test_the_defaults_are_the_papers_setting() -> None:
    config = KassdConfig()
    assert config.classes == ("Car",)
    assert config.grid.size == (1408, 1600, 40)
    assert (config.anchors[0].size, config.keypoints.boundary, config.keypoints.inner) == ((3.9, 1.6, 1.56), 18, 13)
    assert config.keypoints.extra_point is ExtraPoint.ANCHOR
    weights = config.loss_weights
    assert (weights.cls, weights.loc, config.keypoint_weight, weights.direction) == (2.0, 1.0, 1.0, 0.2)
    assert replace(config, swapped=True).loss_weights == LossWeights(1.0, 2.0, 0.2)


def test_swapped_weights_scale_the_losses() -> None:
    torch.manual_seed(0)
    model = kassd(SMALL).eval()
    batch = Batch.of([car_frame(1, CAR)])
    assert batch.labels is not None
    printed = model.loss(model(batch), batch.labels)
    model.config = replace(SMALL, swapped=True)
    swapped = model.loss(model(batch), batch.labels)
    assert set(printed) == {"cls", "loc", "direction", "keypoints"}
    torch.testing.assert_close(swapped["cls"], printed["cls"] / 2)
    torch.testing.assert_close(swapped["loc"], printed["loc"] * 2)
    for name in ("direction", "keypoints"):
        torch.testing.assert_close(swapped[name], printed[name])


CONFIGS = {
    "full": SMALL,
    "baseline": replace(SMALL, llm=False, kam=False),
    "plain-llm": replace(SMALL, frs_reuse=False, lam=False),
    "psa-corners": replace(SMALL, neck=Neck.PSA, keypoints=KeypointLayout(2, 2, 0, 0)),
    "denseaspp-inner": replace(SMALL, neck=Neck.DENSEASPP, keypoints=KeypointLayout(0, 0, 6, 3)),
    "spp-centre": replace(SMALL, neck=Neck.SPP, keypoints=KeypointLayout(extra_point=ExtraPoint.CENTER)),
    "second-soft": replace(SMALL, neck=Neck.SECOND, kam_options=KamOptions(soft_targets=True, box_gradient=True)),
    "three-classes": replace(SMALL, anchors=KITTI_ANCHORS, kam_options=KamOptions(positive_iou=(0.7, 0.5, 0.5))),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_every_parameter_receives_a_gradient(config: KassdConfig) -> None:
    torch.manual_seed(0)
    model = kassd(config)
    batch = Batch.of([car_frame(5, CAR), car_frame(6)])
    assert batch.labels is not None
    predictions = model(batch)
    assert predictions.head.cls.shape == (2, 16 * 16 * 2 * len(config.anchors), len(config.anchors))
    if predictions.maps is not None:
        assert predictions.maps.shape == (2, config.keypoints.count * len(config.anchors), 16, 16)
    total(model.loss(predictions, batch.labels)).backward()
    # a map of a class without any box in the frames is not read: its last convolution's gradient may be zero there
    assert [name for name, p in model.named_parameters() if p.grad is None or not bool(p.grad.any())] == []


def scored_by(maps: torch.Tensor, config: KassdConfig = SMALL, codes: float = 0.0) -> tuple[Kassd, KassdPredictions]:
    """A network's predictions with chosen maps and one sure anchor a quarter of the way into the map."""
    model = kassd(config).eval()
    with torch.no_grad():
        predictions = model(Batch.of([car_frame(1, CAR)]))
    head = predictions.head
    head.cls.fill_(-10.0)
    head.cls[0, (4 * 16 + 8) * 2] = 2.0
    head.box.fill_(codes)
    head.direction.zero_()
    head.direction[..., 1] = 1.0  # keeps the anchor's own heading, 0 radians
    return model, replace(predictions, maps=maps)


def test_the_keypoints_score_replaces_the_class_score_or_multiplies_it() -> None:
    maps = torch.full((1, 31, 16, 16), 1.5)
    model, predictions = scored_by(maps)
    (found,) = model.decode(predictions)
    assert found.scores.tolist() == pytest.approx([1 / (1 + math.exp(-1.5))])
    assert found.boxes[0].tolist() == pytest.approx([6.8, -2.8, -1.0, 3.9, 1.6, 1.56, 0.0], abs=1e-5)
    both = replace(SMALL, kam_options=KamOptions(score=KamScore.MULTIPLY))
    model, predictions = scored_by(maps, both)
    (found,) = model.decode(predictions)
    assert found.scores.tolist() == pytest.approx([1 / (1 + math.exp(-1.5)) / (1 + math.exp(-2.0))])
    model, predictions = scored_by(maps - 3.0)
    assert len(model.decode(predictions)[0]) == 0, "a box the keypoints call bad is dropped, whatever its class score"
    model, predictions = scored_by(maps, replace(SMALL, kam=False))
    (found,) = model.decode(replace(predictions, maps=None))
    assert found.scores.tolist() == pytest.approx([1 / (1 + math.exp(-2.0))])


def test_keypoints_are_read_where_the_box_is_also_in_another_region() -> None:
    torch.manual_seed(0)
    model = kassd(replace(SMALL, frs_reuse=False)).eval()
    maps = torch.zeros(1, 31, 16, 16)
    model, predictions = scored_by(maps)
    rows = torch.tensor([(4 * 16 + 8) * 2])
    boxes = predictions.head.decoded_rows(0, rows)
    place = predictions.head.anchors[rows, :2]
    maps[:, :, 4 - 3 : 4 + 4, 8 - 6 : 8 + 7] = torch.randn(1, 31, 7, 13)
    whole = model.scores(predictions, 0, boxes, torch.zeros(1, dtype=torch.int64), place)
    window = SMALL.grid.window((8, 8), (96, 96))
    moved = KassdPredictions(replace(predictions.head, grid=window), maps[..., 1:13, 1:13])
    torch.testing.assert_close(model.scores(moved, 0, boxes, torch.zeros(1, dtype=torch.int64), place), whole)


def test_labelled_boxes_are_right_and_far_ones_wrong() -> None:
    model, predictions = scored_by(torch.zeros(1, 31, 16, 16))
    objects = predictions.head.decoded_rows(0, torch.tensor([(4 * 16 + 8) * 2]))
    kinds = torch.zeros(1, dtype=torch.int64)
    # the anchor's box and the labelled box are the same and right: two focal losses of a coin toss, 0.25 / 4 * ln 2
    right = model.keypoint_loss(predictions, 0, objects, kinds)
    assert right.item() == pytest.approx(0.25 * 0.25 * math.log(2), rel=1e-5)
    shifted = objects + torch.tensor([0.0, 0.6, 0, 0, 0, 0, 0])  # IoU (1.6 - 0.6) / (1.6 + 0.6) = 0.45
    mixed = model.keypoint_loss(predictions, 0, shifted, kinds)
    assert mixed.item() == pytest.approx((0.25 + 0.75) * 0.25 * math.log(2), rel=1e-5)
    none = model.keypoint_loss(predictions, 0, objects[:0], kinds[:0])
    assert none.item() == pytest.approx(0.75 * 0.25 * math.log(2), rel=1e-5)
    far = model.quality(objects, kinds, torch.cat((shifted, objects)), torch.tensor([0, 1]))
    assert far.item() == pytest.approx(1.0 / 2.2, rel=1e-4), "an object of another class does not count"


def test_without_a_sure_anchor_the_best_ones_learn() -> None:
    model, predictions = scored_by(torch.zeros(1, 31, 16, 16))
    predictions.head.cls.fill_(-10.0)
    nothing = torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64)
    assert model.keypoint_loss(predictions, 0, *nothing).item() == pytest.approx(100 * 0.75 * 0.25 * math.log(2))


def test_the_scores_loss_moves_boxes_only_if_asked() -> None:
    for asked in (False, True):
        torch.manual_seed(0)
        model = kassd(replace(SMALL, kam_options=KamOptions(box_gradient=asked)))
        batch = Batch.of([car_frame(1, CAR)])
        assert batch.labels is not None
        model.loss(model(batch), batch.labels)["keypoints"].backward()
        moved = [
            layer.weight.grad is not None and bool(layer.weight.grad.any())
            for layer in (model.head.box, model.head.cls)
        ]
        assert moved == [asked, False]


def test_overfits_two_cars_and_finds_them() -> None:
    torch.manual_seed(0)
    frame = car_frame(1, CAR, [9.5, -3.5, -1.0, 3.7, 1.6, 1.5, -2.0])
    model = kassd(replace(SMALL, encoder_widths=(4, 8, 8, 8), width=16, kam_width=16))
    batch = Batch.of([frame])
    losses = overfit(model, batch, 70, 0.01)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(batch))
    assert frame.labels is not None
    check_found(found.boxes.detach(), frame.labels.boxes)


def check_found(found: torch.Tensor, labelled: torch.Tensor) -> None:
    distance = torch.cdist(found[:, :2], labelled[:, :2])
    assert float(distance.amin(dim=0).max()) < 0.5, "every labelled car is found"
    assert float(distance.amin(dim=1).max()) < 0.5, "nothing else is found"
    heading = wrap_angle(found[:, 6] - labelled[distance.argmin(dim=1), 6])
    assert float(heading.abs().max()) < 0.5


@pytest.mark.slow
def test_overfits_a_real_scan() -> None:
    source = KittiSource(data_dir("kitti"), "train", fov=True)
    grid = VoxelGrid((0.0, -16.0, -3.0), (32.0, 16.0, 1.0), (0.1, 0.1, 0.1))
    frame = next(f for f in source if f.labels is not None and len(near_cars(f.labels, grid)) >= 4)
    assert frame.labels is not None
    labels = near_cars(frame.labels, grid)
    torch.manual_seed(0)
    model = kassd(replace(SMALL, grid=grid, encoder_widths=(8, 16, 32, 32), encoder_out=32, width=32, kam_width=32))
    batch = Batch.of([replace(frame, labels=labels)])
    losses = overfit(model, batch, 80, 0.005)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(batch))
    check_found(found[found.scores > 0.5].boxes.detach(), labels.boxes)


def near_cars(labels: Labels, grid: VoxelGrid) -> Labels:
    of_cars = labels.of_classes(("Car",))
    return of_cars[grid.contains(of_cars.boxes)]


def test_samples_of_a_batch_do_not_touch_each_other() -> None:
    torch.manual_seed(0)
    model = kassd(SMALL).eval()
    one, two = car_frame(3, CAR), car_frame(4, CAR)
    alone, joined = model(Batch.of([two])), model(Batch.of([one, two]))
    torch.testing.assert_close(joined.head.cls[1], alone.head.cls[0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(joined.maps[1], alone.maps[0], atol=1e-5, rtol=1e-4)
    boxes = torch.tensor([CAR])
    arguments = (boxes, torch.zeros(1, dtype=torch.int64), boxes[:, :2])
    torch.testing.assert_close(
        model.scores(joined, 1, *arguments), model.scores(alone, 0, *arguments), atol=1e-5, rtol=1e-4
    )


@pytest.mark.parametrize("training", [True, False])
def test_sweeps_without_points(training: bool) -> None:
    model = kassd(SMALL).train(training)
    empty = Frame(torch.zeros(0, 4), labels=Labels.empty())
    predictions = model(Batch.of([empty, empty]))
    assert len(model.decode(predictions)) == 2
    losses = model.loss(predictions, [Labels.empty()] * 2)
    assert all(bool(loss.isfinite()) for loss in losses.values())
    total(losses).backward()


def test_a_map_of_odd_size_works() -> None:
    model = kassd(SMALL).eval()
    predictions = model(Batch.of([car_frame(2, CAR)]), SMALL.grid.window((0, 0), (88, 104)))
    assert predictions.maps.shape == (1, 31, 13, 11)
    assert predictions.head.cls.shape == (1, 13 * 11 * 2, 1)


def test_is_built_by_name_and_survives_a_weight_file(tmp_path) -> None:
    options = {
        **config_to_dict(SMALL),
        "neck": "spp",
        "lam_reduce": "mean",
        "keypoints": {"m": 7, "n": 4, "extra_point": "center"},
        "kam_options": {"score": "multiply"},
    }
    model = build("kassd", options)
    assert model.config.neck is Neck.SPP and model.config.kam_options.score is KamScore.MULTIPLY
    assert model.config.keypoints == KeypointLayout(7, 4, 5, 4, ExtraPoint.CENTER)
    save_weights(tmp_path / "w.safetensors", model)
    again = load_weights(tmp_path / "w.safetensors")
    assert again.config == model.config
    batch = Batch.of([car_frame(1, CAR)])
    torch.testing.assert_close(again(batch).maps, model.eval()(batch).maps)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`neck`: .*'llm', 'second', 'psa', 'denseaspp' or 'spp', got 'fpn'"):
        build("kassd", {"neck": "fpn"})
    with pytest.raises(BeamboxError, match="`llm` off is SECOND's backbone, but `neck` asks for spp; change one"):
        replace(SMALL, llm=False, neck=Neck.SPP)
    with pytest.raises(BeamboxError, match="must have 1 entry or one for each of the 1 classes, got 2"):
        replace(SMALL, kam_options=KamOptions(positive_iou=(0.7, 0.5)))
    with pytest.raises(BeamboxError, match="`anchors` must name at least one class"):
        replace(SMALL, anchors=())
    with pytest.raises(BeamboxError, match="without any keypoint"):
        build("kassd", {"keypoints": {"m": 0, "n": 0, "d": 0, "e": 0}})
