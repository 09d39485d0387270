"""Detection that leaves out empty ground finds what detection of every cell finds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from beambox.detectors.kassd import Neck
from beambox.geometry import VoxelGrid
from beambox.infer.ground import EmptyGround
from beambox.infer.predictor import Detector
from beambox.ops.map_conv import GroundedConv
from beambox.structures import Batch, Frame
from oracles.small_detectors import (
    CAR,
    DENNET,
    HCNET,
    KASSD_CONFIG,
    POINTPILLARS,
    SECOND,
    VOXEL_RCNN,
    build_small,
    car_frame,
    output_tensors,
)

TWO: dict[str, Any] = {"widths": (16, 32), "up_widths": (16, 16)}
THREE: dict[str, Any] = {"voxel_channels": 16, "widths": (16, 16, 32), "up_widths": (16, 16, 32)}
WIDE: dict[str, Any] = {  # at least as wide as a vector
    "pointpillars": replace(POINTPILLARS, **THREE),
    "hcnet": replace(HCNET, **THREE, oifm_width=16),
    "hcnet: no averages": replace(HCNET, **THREE, oifm=False, aam=False),
    "second": replace(SECOND, **TWO),
    "voxel_rcnn": replace(VOXEL_RCNN, **TWO),
    "dennet": replace(DENNET, **TWO),
    "kassd": replace(KASSD_CONFIG, width=16, kam_width=16),
    "kassd: PSA": replace(KASSD_CONFIG, width=16, kam_width=16, neck=Neck.PSA),
}


def detector(name: str, seed: int = 0) -> Detector:
    model = build_small(name.partition(":")[0], WIDE[name], seed)
    torch.manual_seed(seed)
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            torch.nn.init.normal_(layer.bias, 0, 0.2)  # pyright: ignore[reportArgumentType]
            torch.nn.init.uniform_(layer.running_mean, -0.2, 0.2)  # pyright: ignore[reportArgumentType]
    return Detector(model, precision="float32", device="cpu")


class NeverLearns(EmptyGround):
    def learn(self, model: torch.nn.Module, grid: VoxelGrid) -> None:
        """Do nothing."""


def answers(found: Detector, *frames: Frame) -> list[torch.Tensor]:
    return output_tensors(found.predict(Batch.of(list(frames))))


@pytest.fixture
def frames() -> list[Frame]:
    corner = torch.tensor([[0.05, -6.3, -1.0, 0.5], [12.7, 6.35, -1.0, 0.2]])
    return [car_frame(0, CAR, reach=6.0), car_frame(1, CAR, ground=5), Frame(corner), Frame(torch.zeros(0, 4))]


@pytest.mark.parametrize("name", WIDE)
def test_the_same_bits_as_when_all_cells_are_computed(name: str, frames: list[Frame]) -> None:
    learned, fresh = detector(name), detector(name)
    for _ in range(2):
        learned.predict(Batch.of(frames[:1]))
    memories = [
        part.folded for part in learned.model.modules() if isinstance(getattr(part, "folded", None), GroundedConv)
    ]
    assert memories and all(memory._grounds for memory in memories), "else nothing is left out"
    fresh.ground = NeverLearns()
    for some in ([frame] for frame in frames):
        assert all(map(torch.equal, answers(learned, *some), answers(fresh, *some)))
    assert all(map(torch.equal, answers(learned, *frames), answers(fresh, *frames)))


@pytest.mark.parametrize("name", WIDE)
def test_the_same_as_pytorch_to_rounding(name: str, frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    found = detector(name)
    ours = [answers(found, frame) for frame in frames * 2][len(frames) :]
    monkeypatch.setenv("BEAMBOX_BACKEND", "reference")
    for frame, one in zip(frames, ours):
        for mine, plain in zip(one, answers(detector(name), frame)):
            torch.testing.assert_close(mine, plain, rtol=0, atol=1e-5 * max(1.0, float(plain.abs().max())))


def test_changed_weights_are_noticed_and_learnt_again(frames: list[Frame]) -> None:
    found = detector("pointpillars")
    for _ in range(3):
        found.predict(Batch.of(frames[:1]))
    other = detector("pointpillars", seed=5)
    found.model.load_state_dict(other.model.state_dict())
    for _ in range(3):
        assert all(map(torch.equal, answers(found, frames[0]), answers(detector("pointpillars", seed=5), frames[0])))
    assert found.ground.learnt()


def test_parameters_put_in_place_of_others_are_used(frames: list[Frame]) -> None:
    found = detector("pointpillars")
    for _ in range(3):
        found.predict(Batch.of(frames[:1]))
    conv = found.model.backbone.stages[0][1][0]
    conv.weight = torch.nn.Parameter(-2 * conv.weight.detach())
    fresh = detector("pointpillars")
    with torch.no_grad():
        fresh.model.backbone.stages[0][1][0].weight.mul_(-2)
    assert all(map(torch.equal, answers(found, frames[0]), answers(fresh, frames[0])))


def test_another_region_is_learnt_for_itself(frames: list[Frame]) -> None:
    found = detector("second")
    for _ in range(2):
        found.predict(Batch.of(frames[:1]))
    grid = found.grid
    found.grid = replace(grid, minimum=(1.6, -4.8, -3.0))
    fresh = detector("second")
    fresh.grid = found.grid
    for _ in range(3):
        assert all(map(torch.equal, answers(found, frames[0]), answers(fresh, frames[0])))
        fresh = detector("second")
        fresh.grid = found.grid


def test_weights_made_in_inference_mode_still_detect(frames: list[Frame]) -> None:
    """Their changes cannot be noticed, so nothing is remembered."""
    with torch.inference_mode():
        found = detector("pointpillars")
        plain = answers(found, frames[0])
        for _ in range(2):
            assert all(map(torch.equal, answers(found, frames[0]), plain))
    assert not found.ground.learnt()
