import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from beambox.checks import BeamboxError
from beambox.detectors.catalog import build, config_to_dict
from beambox.detectors.kassd import KASSD, KamOptions, KamScore, KASSDConfig, KASSDPredictions, Neck, kassd
from beambox.detectors.kassd.keypoints import ExtraPoint, KeypointLayout
from beambox.detectors.kassd.network import LamReduce
from beambox.detectors.second import KITTI_CAR, second
from beambox.geometry.grid import VoxelGrid
from beambox.layers.heads import AnchorPredictions, LossWeights
from beambox.layers.roi import best_overlap
from beambox.structures import Batch, Labels
from oracles.learning import check_found, check_headings, learn_by_heart, scan_with_cars
from oracles.small_detectors import CAR, KASSD_CONFIG, VARIANTS, build_small, car_frame


def size_of(config: KASSDConfig) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in kassd(config).parameters())


def test_each_switch_has_the_parameters_of_its_parts() -> None:
    full = KASSDConfig()
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
        ours, theirs = kassd(KASSDConfig(llm=False, kam=False)), second(KITTI_CAR)
    assert [p.shape for p in ours.parameters()] == [p.shape for p in theirs.parameters()]


def test_the_defaults_are_the_papers_setting() -> None:
    config = KASSDConfig()
    assert config.classes == ("Car",)
    assert config.grid.size == (1408, 1600, 40)
    assert (config.anchors[0].size, config.keypoints.boundary, config.keypoints.inner) == ((3.9, 1.6, 1.56), 18, 13)
    assert config.keypoints.extra_point is ExtraPoint.ANCHOR
    weights = config.loss_weights
    assert (weights.cls, weights.loc, config.keypoint_weight, weights.direction) == (2.0, 1.0, 1.0, 0.2)
    assert replace(config, swap_cls_loc_weights=True).loss_weights == LossWeights(1.0, 2.0, 0.2)


def test_swapped_weights_scale_the_losses() -> None:
    torch.manual_seed(0)
    model = kassd(KASSD_CONFIG).eval()
    batch = Batch.of([car_frame(1, CAR)])
    assert batch.labels is not None
    printed = model.loss(model(batch, labels=batch.labels), batch.labels)
    model.config = replace(KASSD_CONFIG, swap_cls_loc_weights=True)
    swap_cls_loc_weights = model.loss(model(batch, labels=batch.labels), batch.labels)
    assert set(printed) == {"cls", "loc", "direction", "keypoints"}
    torch.testing.assert_close(swap_cls_loc_weights["cls"], printed["cls"] / 2)
    torch.testing.assert_close(swap_cls_loc_weights["loc"], printed["loc"] * 2)
    for name in ("direction", "keypoints"):
        torch.testing.assert_close(swap_cls_loc_weights[name], printed[name])


OF_KASSD = {name: config for name, config in VARIANTS.items() if isinstance(config, KASSDConfig)}


@pytest.mark.parametrize("config", OF_KASSD.values(), ids=OF_KASSD.keys())
def test_there_is_a_map_for_every_keypoint_of_every_class(config: KASSDConfig) -> None:
    maps = build_small("kassd", config)(Batch.of([car_frame(5, CAR), car_frame(6)])).maps
    if config.kam:
        assert maps.shape == (2, config.keypoints.count * len(config.anchors), 16, 16)
    else:
        assert maps is None


def scored_by(
    maps: torch.Tensor, config: KASSDConfig = KASSD_CONFIG, deltas: float = 0.0
) -> tuple[KASSD, KASSDPredictions]:
    """A network's predictions with chosen maps and one sure anchor a quarter of the way into the map."""
    model = kassd(config).eval()
    with torch.no_grad():
        predictions = model(Batch.of([car_frame(1, CAR)]))
    head = predictions.head
    head.cls.fill_(-10.0)
    head.cls[0, (4 * 16 + 8) * 2] = 2.0
    head.box.fill_(deltas)
    head.direction.zero_()
    head.direction[..., 1] = 1.0  # keeps the anchor's own heading, 0 radians
    return model, replace(predictions, maps=maps, **scores_of(model, predictions.head, maps))


def scores_of(
    model: KASSD, head: AnchorPredictions, maps: torch.Tensor, labels: list[Labels] | None = None
) -> dict[str, Any]:
    """What KAM says, given its maps and what the head says."""
    if model.kam is None:
        return {"candidates": None, "scores": None}
    boxes = model.candidates(head, labels)
    scores = model.kam.score(maps, head.grid, boxes.sample, boxes.boxes, boxes.classes, boxes.anchor_xy)
    return {"candidates": boxes, "scores": scores}


def test_the_keypoints_score_replaces_the_class_score_or_multiplies_it() -> None:
    maps = torch.full((1, 31, 16, 16), 1.5)
    model, predictions = scored_by(maps)
    (found,) = model.decode(predictions)
    assert found.scores.tolist() == pytest.approx([1 / (1 + math.exp(-1.5))])
    assert found.boxes[0].tolist() == pytest.approx([6.8, -2.8, -1.0, 3.9, 1.6, 1.56, 0.0], abs=1e-5)
    both = replace(KASSD_CONFIG, kam_options=KamOptions(score=KamScore.MULTIPLY))
    model, predictions = scored_by(maps, both)
    (found,) = model.decode(predictions)
    assert found.scores.tolist() == pytest.approx([1 / (1 + math.exp(-1.5)) / (1 + math.exp(-2.0))])
    model, predictions = scored_by(maps - 3.0)
    assert len(model.decode(predictions)[0]) == 0, "a box the keypoints call bad is dropped, whatever its class score"
    model, predictions = scored_by(maps, replace(KASSD_CONFIG, kam=False))
    (found,) = model.decode(predictions)
    assert found.scores.tolist() == pytest.approx([1 / (1 + math.exp(-2.0))])


def test_keypoints_are_read_where_the_box_is_also_in_another_region() -> None:
    torch.manual_seed(0)
    model = kassd(replace(KASSD_CONFIG, frs_reuse=False)).eval()
    maps = torch.zeros(1, 31, 16, 16)
    model, predictions = scored_by(maps)
    rows = torch.tensor([(4 * 16 + 8) * 2])
    boxes = predictions.head.decoded_rows(0, rows)
    place = predictions.head.anchors[rows, :2]
    maps[:, :, 4 - 3 : 4 + 4, 8 - 6 : 8 + 7] = torch.randn(1, 31, 7, 13)
    assert model.kam is not None
    zero = torch.zeros(1, dtype=torch.int64)
    whole = model.kam.score(maps, KASSD_CONFIG.grid, zero, boxes, zero, place)
    window = KASSD_CONFIG.grid.window((8, 8), (96, 96))
    torch.testing.assert_close(model.kam.score(maps[..., 1:13, 1:13], window, zero, boxes, zero, place), whole)


def test_labeled_boxes_are_right_and_far_ones_wrong() -> None:
    model, predictions = scored_by(torch.zeros(1, 31, 16, 16))
    objects = predictions.head.decoded_rows(0, torch.tensor([(4 * 16 + 8) * 2]))

    def loss(boxes: torch.Tensor) -> float:
        labels = [Labels(boxes, ("Car",) * len(boxes))]
        return model.loss(replace(predictions, **scores_of(model, predictions.head, predictions.maps, labels)), labels)[
            "keypoints"
        ].item()

    # the anchor's box and the labelled box are the same and right: two focal losses of a coin toss, 0.25 / 4 * ln 2
    assert loss(objects) == pytest.approx(0.25 * 0.25 * math.log(2), rel=1e-5)
    shifted = objects + torch.tensor([0.0, 0.6, 0, 0, 0, 0, 0])  # IoU (1.6 - 0.6) / (1.6 + 0.6) = 0.45
    assert loss(shifted) == pytest.approx((0.25 + 0.75) * 0.25 * math.log(2), rel=1e-5)
    assert loss(objects[:0]) == pytest.approx(0.75 * 0.25 * math.log(2), rel=1e-5)
    far, _ = best_overlap(objects, torch.tensor([0]), torch.cat((shifted, objects)), torch.tensor([0, 1]))
    assert far.item() == pytest.approx(1.0 / 2.2, rel=1e-4), "an object of another class does not count"


def test_without_a_sure_anchor_the_best_ones_learn() -> None:
    model, predictions = scored_by(torch.zeros(1, 31, 16, 16))
    predictions.head.cls.fill_(-10.0)
    of_best = replace(predictions, **scores_of(model, predictions.head, predictions.maps, [Labels.empty()]))
    assert model.loss(of_best, [Labels.empty()])["keypoints"].item() == pytest.approx(100 * 0.75 * 0.25 * math.log(2))


def test_the_scores_loss_moves_boxes_only_if_asked() -> None:
    for asked in (False, True):
        torch.manual_seed(0)
        model = kassd(replace(KASSD_CONFIG, kam_options=KamOptions(box_gradient=asked)))
        batch = Batch.of([car_frame(1, CAR)])
        assert batch.labels is not None
        model.loss(model(batch, labels=batch.labels), batch.labels)["keypoints"].backward()
        moved = [
            layer.weight.grad is not None and bool(layer.weight.grad.any())
            for layer in (model.head.box, model.head.cls)
        ]
        assert moved == [asked, False]


def test_overfits_two_cars_and_finds_them() -> None:
    frame = car_frame(1, CAR, [9.5, -3.5, -1.0, 3.7, 1.6, 1.5, -2.0])
    model = build_small("kassd", replace(KASSD_CONFIG, encoder_widths=(4, 8, 8, 8), width=16, kam_width=16))
    losses = learn_by_heart(model, frame, 70, 0.01)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(Batch.of([frame])))
    check_found(found.boxes.detach(), frame.labels.boxes)
    check_headings(found.boxes.detach(), frame.labels.boxes)


@pytest.mark.slow
def test_overfits_a_real_scan() -> None:
    grid = VoxelGrid((0.0, -16.0, -3.0), (32.0, 16.0, 1.0), (0.1, 0.1, 0.1))
    frame = scan_with_cars(grid)
    model = build_small(
        "kassd",
        replace(KASSD_CONFIG, grid=grid, encoder_widths=(8, 16, 32, 32), encoder_out=32, width=32, kam_width=32),
    )
    losses = learn_by_heart(model, frame, 80, 0.005)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(Batch.of([frame])))
    boxes = found[found.scores > 0.5].boxes.detach()
    check_found(boxes, frame.labels.boxes)
    check_headings(boxes, frame.labels.boxes)


def test_scores_of_a_sample_do_not_depend_on_its_neighbors() -> None:
    model = build_small("kassd").eval()
    one, two = car_frame(3, CAR), car_frame(4, CAR)
    alone, joined = model(Batch.of([two])), model(Batch.of([one, two]))
    boxes, zero = torch.tensor([CAR]), torch.zeros(1, dtype=torch.int64)
    read = [
        model.kam.score(given.maps, KASSD_CONFIG.grid, sample, boxes, zero, boxes[:, :2])
        for given, sample in ((joined, zero + 1), (alone, zero))
    ]
    torch.testing.assert_close(*read, atol=1e-5, rtol=1e-4)


def test_a_map_of_odd_size_works() -> None:
    model = kassd(KASSD_CONFIG).eval()
    predictions = model(Batch.of([car_frame(2, CAR)]), KASSD_CONFIG.grid.window((0, 0), (88, 104)))
    assert predictions.maps.shape == (1, 31, 13, 11)
    assert predictions.head.cls.shape == (1, 13 * 11 * 2, 1)


def test_options_are_read_as_plain_values() -> None:
    options = {
        **config_to_dict(KASSD_CONFIG),
        "neck": "spp",
        "lam_reduce": "mean",
        "keypoints": {"m": 7, "n": 4, "extra_point": "center"},
        "kam_options": {"score": "multiply"},
    }
    model = build("kassd", options)
    assert model.config.neck is Neck.SPP and model.config.kam_options.score is KamScore.MULTIPLY
    assert model.config.keypoints == KeypointLayout(7, 4, 5, 4, ExtraPoint.CENTER)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(BeamboxError, match=r"`neck`: .*'llm', 'second', 'psa', 'denseaspp' or 'spp', got 'fpn'"):
        build("kassd", {"neck": "fpn"})
    with pytest.raises(BeamboxError, match="`llm` off is SECOND's backbone, but `neck` asks for spp; change one"):
        replace(KASSD_CONFIG, llm=False, neck=Neck.SPP)
    with pytest.raises(BeamboxError, match="must have 1 entry or one for each of the 1 classes, got 2"):
        replace(KASSD_CONFIG, kam_options=KamOptions(positive_iou=(0.7, 0.5)))
    with pytest.raises(BeamboxError, match="`anchors` must name at least one class"):
        replace(KASSD_CONFIG, anchors=())
    with pytest.raises(BeamboxError, match="without any keypoint"):
        build("kassd", {"keypoints": {"m": 0, "n": 0, "d": 0, "e": 0}})
