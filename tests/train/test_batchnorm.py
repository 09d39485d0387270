"""Batch-norm statistics measured anew: equal to statistics by hand, harmless to training, and what short runs need."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from beambox.detectors.catalog import CATALOG
from beambox.detectors.weights import load_weights
from beambox.structures import Batch
from beambox.train.batchnorm import Moments, batch_norms, measure_statistics
from beambox.train.dataset import TrainingBatch
from beambox.train.log import RunLog, Timer
from beambox.train.loop import ModelWithLoss, Run
from oracles.small_detectors import CAR, build_small, car_frame
from oracles.tiny_training import frames, recipe, tiny_run


class Net(nn.Module):
    """Layers of every kind that matter: two batch norms in a row, dropout between, one that never runs."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.norm = nn.Linear(3, 4), nn.BatchNorm1d(4, momentum=0.01)
        self.drop, self.second, self.last = nn.Dropout(0.5), nn.Linear(4, 2), nn.BatchNorm1d(2)
        self.unused = nn.BatchNorm1d(5)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(self.second(self.drop(self.norm(self.first(x)))))


def by_hand(net: Net, batches: list[Tensor]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Statistics of both layers in float64: the first layer normalizes each batch by that batch."""
    seen: dict[str, list[np.ndarray]] = {"norm": [], "last": []}
    for batch in batches:
        x = batch.double().numpy() @ net.first.weight.detach().double().numpy().T + net.first.bias.detach().numpy()
        seen["norm"].append(x)
        x = (x - x.mean(0)) / np.sqrt(x.var(0) + net.norm.eps)
        seen["last"].append(x @ net.second.weight.detach().double().numpy().T + net.second.bias.detach().numpy())
    joined = {name: np.concatenate(values) for name, values in seen.items()}
    return {name: (values.mean(0), values.var(0, ddof=1)) for name, values in joined.items()}


def batches_of(*sizes: int) -> list[Tensor]:
    """Batches of different sizes and means, so that the variance between them is most of the whole."""
    torch.manual_seed(3)
    return [torch.randn(size, 3) + 10 * number for number, size in enumerate(sizes)]


def test_statistics_equal_those_by_hand() -> None:
    torch.manual_seed(1)
    net, batches = Net().eval(), batches_of(7, 2, 30)
    net.drop.train()  # a mode of its own must come back
    expected = by_hand(net, batches)
    measure_statistics(net, batches, net)
    for name, (mean, variance) in expected.items():
        layer = getattr(net, name)
        torch.testing.assert_close(layer.running_mean, torch.tensor(mean).float(), rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(layer.running_var, torch.tensor(variance).float(), rtol=1e-5, atol=1e-5)
        assert layer.num_batches_tracked == 0
    assert (net.norm.momentum, net.last.momentum) == (0.01, 0.1)
    assert net.unused.running_mean is not None
    assert torch.equal(net.unused.running_mean, torch.zeros(5))
    assert [layer.training for layer in (net, net.norm, net.drop)] == [False, False, True]
    assert not any(layer._forward_pre_hooks for layer in batch_norms(net).values())


def test_no_batches_leave_the_statistics() -> None:
    net = Net()
    net(torch.randn(8, 3))
    before = {name: value.clone() for name, value in net.state_dict().items()}
    measure_statistics(net, [], net)
    assert all(torch.equal(before[name], value) for name, value in net.state_dict().items())


def test_moments_of_large_offsets_keep_their_digits() -> None:
    moments, values = Moments(1, torch.device("cpu")), torch.randn(4, 1000, 1) + 1e4
    for part in values:
        moments.add(part)
    assert moments.statistics is not None
    assert moments.statistics[1].item() == pytest.approx(values.double().var().item(), rel=1e-3)


def test_processes_gather_what_one_process_measures() -> None:
    torch.manual_seed(1)
    one, batches = Net(), batches_of(7, 2, 30, 5)
    two = [Net(), Net()]
    for net in two:
        net.load_state_dict(one.state_dict())
    measure_statistics(one, batches, one)
    packed: dict[int, list[Tensor]] = {0: [], 1: []}
    for rank, net in enumerate(two):  # first what each process has, then the gathering
        measure_statistics(net, batches[rank::2], net, lambda t, rank=rank: packed[rank].append(t) or t[None])
    for net in two:
        joined = iter([torch.stack(pair) for pair in zip(packed[0], packed[1])])
        measure_statistics(net, [], net, lambda _, joined=joined: next(joined))
        for name, value in one.state_dict().items():
            torch.testing.assert_close(net.state_dict()[name], value, rtol=1e-6, atol=1e-6)


def test_measuring_does_not_disturb_training(tmp_path: Path) -> None:
    plain, measured = tiny_run(tmp_path), tiny_run(tmp_path)
    for step in range(4):
        for run in (plain, measured):
            run.module.train()
            run.train_step(run.dataset[step], Timer())
        saved = {name: value.clone() for name, value in measured.result.state_dict().items()}
        with measured.measured():
            inside = {name: value.clone() for name, value in measured.result.state_dict().items()}
        assert any(not torch.equal(saved[name], inside[name]) for name in saved)
        assert all(torch.equal(saved[name], inside[name]) for name in saved if "running" not in name)
    for one, other in ((plain.detector, measured.detector), (plain.result, measured.result)):
        assert all(torch.equal(v, other.state_dict()[k]) for k, v in one.state_dict().items())


def test_measured_statistics_are_a_function_of_weights_seed_and_step(tmp_path: Path) -> None:
    kept = []
    for workers in (0, 1):
        run = tiny_run(tmp_path, recipe().model_copy(update={"workers": workers}))
        for step in range(3):
            run.module.train()
            run.train_step(run.dataset[step], Timer())
        torch.manual_seed(workers)
        with run.measured():
            kept.append({name: value.clone() for name, value in run.result.state_dict().items()})
    assert all(torch.equal(value, kept[1][name]) for name, value in kept[0].items())


@pytest.mark.parametrize("name", sorted(CATALOG))
def test_every_layer_of_every_detector_is_measured(name: str) -> None:
    """The second stages too, whose layers run in the loss alone."""
    model = build_small(name)
    work = TrainingBatch(Batch.of([car_frame(1, CAR), car_frame(2, CAR)]), None)
    measure_statistics(model, [work], ModelWithLoss(model))
    for layer_name, layer in batch_norms(model).items():
        assert layer.running_mean is not None
        assert layer.running_mean.any(), f"{layer_name} was not measured"


def moderate_ap(model: nn.Module) -> float:
    from beambox.infer.evaluate import detect_frames, network, score_frames, scored_frames

    found = scored_frames(detect_frames(network(model), frames(40, seed=5)))
    return score_frames(found, ["Car"], {"Car": 0.5}).classes[0].bev[0].all_points


def test_short_run_scores_as_with_exact_statistics(tmp_path: Path) -> None:
    """200 steps and averaged weights: the exported network is within a point of one with statistics of all frames."""
    settings = recipe(iterations=200, lr=0.01).model_copy(update={"log_every": 200})
    run = tiny_run(tmp_path, settings, count=30, window=None)
    assert run.loop(RunLog(tmp_path, run.total, 0, active=False))
    moving = moderate_ap(run.result)
    with run.measured():
        exported = moderate_ap(load_weights(run.export("final.safetensors", {})))
    exact = run.result
    steps: list[Callable[[], object]] = [lambda i=i: exact(run.dataset[i].batch) for i in range(200)]
    measure_statistics(exact, steps, lambda step: step())
    expected = moderate_ap(exact)
    assert expected > 30
    assert abs(exported - expected) <= 1
    assert moving < expected - 10, "the moving averages would do as well, so this test shows nothing"


def test_zero_batches_keep_the_moving_averages(tmp_path: Path) -> None:
    run: Run = tiny_run(tmp_path, recipe().model_copy(update={"batchnorm_batches": 0}))
    run.train_step(run.dataset[0], Timer())
    saved = {name: value.clone() for name, value in run.result.state_dict().items()}
    with run.measured():
        assert all(torch.equal(value, run.result.state_dict()[name]) for name, value in saved.items())
