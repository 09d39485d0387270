"""What every detector of the catalogue must do, whatever it is made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

import beambox.detectors.voxel_rcnn
from beambox.checks import BeamboxError
from beambox.detectors.catalog import CATALOG, build, config_to_dict
from beambox.detectors.weights import load_weights, save_weights
from beambox.infer.bn_folding import fold_batch_norms
from beambox.layers.roi import Rois, propose
from beambox.structures import Batch, Frame, Labels
from oracles.learning import learn_by_heart
from oracles.small_detectors import CAR, SMALL, VARIANTS, build_small, car_frame, first_stage, output_tensors, total

ONE_STAGE = {"cls", "loc", "direction"}
TWO_STAGES = ONE_STAGE | {"roi_cls", "roi_box", "roi_corner"}
LOSSES = {
    "dennet": TWO_STAGES,
    "hcnet": ONE_STAGE,
    "kassd": ONE_STAGE | {"keypoints"},
    "pointpillars": ONE_STAGE,
    "second": ONE_STAGE,
    "voxel_rcnn": TWO_STAGES,
}
CELLS = {"dennet": 64, "hcnet": 1024, "kassd": 256, "pointpillars": 1024, "second": 256, "voxel_rcnn": 256}
"""Of the small ones' maps."""


def test_every_detector_has_a_small_one() -> None:
    assert set(SMALL) == set(CATALOG)


@pytest.mark.parametrize("name", CATALOG)
def test_dense_layers_hold_most_convolutions_on_maps(name: str) -> None:
    with torch.device("meta"):
        model = CATALOG[name].build(CATALOG[name].config())
    inside = sum(count(layer) for layer in model.dense)
    assert inside > 0.8 * count(model)


def count(module: nn.Module) -> int:
    layers = [layer for layer in module.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)]
    return sum(layer.weight.numel() for layer in layers)


LONG_TO_COMPILE = ("hcnet", "kassd")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG_TO_COMPILE else ()) for name in CATALOG]
)
def test_a_compiled_detector_says_and_learns_the_same(name: str) -> None:
    torch.compiler.reset()
    plain, compiled = build_small(name).eval(), build_small(name).eval()
    runs: list[Any] = []

    def backend(graph: Any, _: Any) -> Any:
        def run(*inputs: Any) -> Any:
            runs.append(graph)
            return graph.forward(*inputs)

        return run

    for layer in compiled.dense:
        layer.compile(backend=backend, dynamic=False)
    batch = Batch.of([car_frame(1, CAR)])
    gradients = []
    for model in (plain, compiled):
        torch.manual_seed(0)
        total(model.loss(model(batch, labels=batch.labels), batch.labels)).backward()
        gradients.append({key: value.grad for key, value in model.named_parameters()})
    assert len(runs) == len(compiled.dense), "each layer is one graph without a break, and none is passed over"
    for key, gradient in gradients[0].items():
        torch.testing.assert_close(gradients[1][key], gradient, msg=lambda text, key=key: f"{key}: {text}")
    torch.testing.assert_close(output_tensors(compiled(batch)), output_tensors(plain(batch)))


@pytest.mark.parametrize("variant", VARIANTS)
def test_losses_reach_every_parameter(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name = variant.split(":", maxsplit=1)[0]
    config = VARIANTS[variant]
    model = build_small(name, config)
    batch = Batch.of([car_frame(5, CAR), car_frame(6)])

    def some_found_the_car(*arguments: Any) -> Rois:
        rois = propose(*arguments)
        rois.boxes[::2] = torch.tensor(CAR)
        return rois

    monkeypatch.setattr(beambox.detectors.voxel_rcnn, "propose", some_found_the_car)  # so that there is what to refine
    predictions = model(batch, labels=batch.labels)
    first = first_stage(predictions)
    assert len(first.anchors) == CELLS[name] * 2 * len(config.classes)
    assert first.cls.shape == (2, len(first.anchors), len(config.classes))
    losses = model.loss(predictions, batch.labels)
    assert set(losses) == LOSSES[name] - (set() if getattr(config, "kam", True) else {"keypoints"})
    total(losses).backward()
    gradients = {key: parameter.grad for key, parameter in model.named_parameters()}
    assert [key for key, grad in gradients.items() if grad is None or not bool(grad.isfinite().all())] == []
    assert [key for key, grad in gradients.items() if not bool(grad.any())] == []


@pytest.mark.parametrize("name", CATALOG)
def test_samples_of_a_batch_do_not_touch_each_other(name: str) -> None:
    model = build_small(name).eval()
    one, two = car_frame(3, CAR), car_frame(4, CAR)
    with torch.inference_mode():
        alone, joined = output_tensors(model(Batch.of([two]))), output_tensors(model(Batch.of([one, two])))
    torch.testing.assert_close([part[1:] for part in joined], alone, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("name", CATALOG)
def test_sweeps_without_points_give_predictions_a_loss_and_no_error(name: str, training: bool, count: int) -> None:
    model = build_small(name).train(training)
    empty = Frame(torch.zeros(0, 4), labels=Labels.empty())
    predictions = model(Batch.of([empty] * count))
    assert bool(first_stage(predictions).cls.isfinite().all())
    assert len(model.decode(predictions)) == count
    nothing = [Labels.empty()] * count
    losses = model.loss(model(Batch.of([empty] * count), labels=nothing), nothing)
    assert all(bool(loss.isfinite()) for loss in losses.values())
    total(losses).backward()
    gradients = {key: parameter.grad for key, parameter in model.named_parameters()}
    assert [key for key, grad in gradients.items() if grad is None] == [], "DDP waits for every parameter"


@pytest.mark.parametrize("name", CATALOG)
def test_another_region_of_the_same_cells(name: str) -> None:
    model = build_small(name).eval()
    window = SMALL[name].grid.window((8, 8), (40, 24))
    batch = Batch.of([car_frame(1, CAR)])
    with torch.inference_mode():
        whole, part = first_stage(model(batch)), first_stage(model(batch, window))
    ny, nx = SMALL[name].grid.shape[1:]
    assert part.grid == window
    assert part.cls.shape[1] == len(part.anchors) == len(whole.anchors) * (40 * 24) // (ny * nx)
    assert not torch.equal(part.anchors[0], whole.anchors[0])


@pytest.mark.parametrize("variant", VARIANTS)
def test_is_built_by_name_and_survives_a_weight_file(variant: str, tmp_path: Path) -> None:
    model = build(variant.split(":", maxsplit=1)[0], config_to_dict(VARIANTS[variant]))
    assert model.config == VARIANTS[variant]
    save_weights(tmp_path / "w.safetensors", model)
    again = load_weights(tmp_path / "w.safetensors")
    assert type(again) is type(model) and again.config == model.config
    batch = Batch.of([car_frame(1, CAR)])
    with torch.inference_mode():
        torch.testing.assert_close(output_tensors(again(batch)), output_tensors(model.eval()(batch)))


@pytest.mark.parametrize("name", CATALOG)
def test_folded_batch_norms_predict_the_same(name: str) -> None:
    model = build_small(name)
    batch = Batch.of([car_frame(1, CAR)])
    with torch.inference_mode():
        for layer in model.modules():
            if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
                layer.momentum = 1.0  # one pass in training mode makes the statistics those of the sweep
                nn.init.uniform_(layer.weight, 0.5, 1.5)
                nn.init.normal_(layer.bias, 0, 0.2)
        model.train()(batch)
        folded = fold_batch_norms(model.eval())
        plain, changed = output_tensors(model(batch)), output_tensors(folded(batch))
    assert float(plain[0].std()) > 0.01, "a network that says the same everywhere would prove nothing"
    torch.testing.assert_close(changed, plain, rtol=0, atol=2e-5)
    assert not any(isinstance(layer, nn.BatchNorm2d) for part in folded.dense for layer in part.modules())


@pytest.mark.parametrize("name", ["pointpillars", "hcnet"])
def test_overfits_two_cars_and_finds_them(name: str) -> None:
    model = build_small(name)
    cars = [6, 2, -1, 4.0, 1.7, 1.5, 0.4], [13, -4, -1, 3.7, 1.6, 1.5, -2.0]
    frame = car_frame(1, *cars, ground=1500, reach=20.0)
    losses = learn_by_heart(model, frame, 80, 0.01)
    assert losses[-1] < 0.1 * losses[0]
    (found,) = model.decode(model(Batch.of([frame])))
    best = found[:2].boxes.detach()
    best = best[best[:, 0].argsort()]
    labeled = torch.tensor(cars)
    torch.testing.assert_close(best[:, :2], labeled[:, :2], atol=0.3, rtol=0)
    assert bool((torch.cos(best[:, 6] - labeled[:, 6]) > 0.9).all())


@pytest.mark.parametrize("name", ["dennet", "kassd", "voxel_rcnn"])
def test_predictions_to_learn_and_to_detect_are_not_mixed_up(name: str) -> None:
    model = build_small(name).eval()
    batch = Batch.of([car_frame(1, CAR)])
    with torch.inference_mode():
        with pytest.raises(BeamboxError, match=r"call model\(batch, labels=labels\)"):
            model.loss(model(batch), batch.labels)
        with pytest.raises(BeamboxError, match=r"without labels: call model\(batch\)"):
            model.decode(model(batch, labels=batch.labels))


@pytest.mark.parametrize("name", ["dennet", "kassd", "voxel_rcnn"])
def test_mixed_precision_covers_the_second_step_but_not_its_answers(name: str) -> None:
    model = build_small(name)
    hidden: list[torch.dtype] = []
    layer = model.kam.maps[0] if name == "kassd" else model.roi_head.shared[0]
    layer.register_forward_hook(lambda _module, _given, out: hidden.append(out.dtype))
    batch = Batch.of([car_frame(1, CAR)])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        predictions = model(batch, labels=batch.labels)
    assert hidden == [torch.bfloat16]
    answers = [predictions.maps, predictions.scores] if name == "kassd" else list(vars(predictions.refined).values())
    assert [answer.dtype for answer in answers] == [torch.float32] * 2
    total(model.loss(predictions, batch.labels)).backward()
    assert all(bool(p.grad.isfinite().all()) for p in model.parameters() if p.grad is not None)
