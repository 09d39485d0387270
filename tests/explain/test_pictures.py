"""Pictures of attention: what they draw is what the network computes, checked against the network itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from beambox.checks import BeamboxError
from beambox.detectors.catalog import CATALOG
from beambox.detectors.dennet import NeighborhoodAttention
from beambox.detectors.kassd import KamOptions
from beambox.detectors.weights import save_weights
from beambox.explain import pictures
from beambox.explain.drawing import scatter_map
from beambox.explain.pictures import explain
from beambox.geometry.grid import VoxelGrid
from beambox.infer.predictor import Detector
from beambox.layers.heads import PostProcess
from beambox.ops.neighborhood.reference import neighborhood_attention, neighborhood_weights
from beambox.structures import Batch, Frame
from oracles.command_line import beambox
from oracles.small_detectors import SMALL

POINTS = torch.rand(3000, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor([12.0, 12, 3, 1])
FRAME = Frame(POINTS - torch.tensor([0, 6.0, 2.5, 0]), "sweep")


EVERYTHING: dict[str, Any] = {"kam_options": KamOptions(threshold=0.0), "post": PostProcess(0.0, 0.1, 100, 10)}
"""KASSD that leaves no box out, however bad."""


def detector(name: str, **changes: Any) -> Detector:
    torch.manual_seed(1)
    return Detector(CATALOG[name].build(replace(SMALL[name], **changes)), device="cpu", precision="float32")


@pytest.mark.parametrize(
    ("name", "changes", "wanted"),
    [
        ("hcnet", {}, ["height_weights", "height_winner", "channel_weights"]),
        ("kassd", EVERYTHING, ["location_weights", "keypoint_maps", "keypoint_scores"]),
        ("kassd", {"lam": False, "kam": False}, []),
        ("dennet", {}, ["densities", "neighborhood_1", "neighborhood_2"]),
        ("dennet", {"vda": False}, ["neighborhood_1", "neighborhood_2"]),
    ],
)
def test_each_detector_shows_its_own_modules(name: str, changes: dict[str, Any], wanted: list[str]) -> None:
    explained = explain(detector(name, **changes), FRAME, score_threshold=0.0)
    optional = {"neighborhood_1", "neighborhood_2"}  # of detections, which random weights may lack
    names = [each.name for each in explained]
    assert [each for each in wanted if each not in optional] == [each for each in names if each not in optional]
    assert set(names) <= set(wanted)
    for each in explained:
        assert min(each.picture.size) > 200 and np.asarray(each.picture).std() > 5


def test_detectors_without_attention_and_empty_sweeps_are_refused() -> None:
    with pytest.raises(BeamboxError, match="PointPillars has no attention to draw"):
        explain(detector("pointpillars"), FRAME)
    with pytest.raises(BeamboxError, match="no point where the network looks"):
        explain(detector("hcnet"), Frame(torch.zeros(0, 4)))


def test_weights_of_a_neighborhood_are_those_that_attention_uses() -> None:
    generator = torch.Generator().manual_seed(2)
    q, k, v = (torch.randn(1, 2, 9, 11, 4, generator=generator, dtype=torch.float64) for _ in range(3))
    bias = torch.randn(2, 9, 9, generator=generator, dtype=torch.float64)
    weights = neighborhood_weights(q, k, bias, 5)
    assert torch.allclose(weights.sum(dim=(4, 5)), torch.ones(()).double())
    out = neighborhood_attention(q, k, v, bias, 5)
    mine = (weights[0, 1, 4, 6][..., None] * v[0, 1, 2:7, 4:9]).sum(dim=(0, 1))
    assert torch.allclose(out[0, 1, 4, 6], mine)


@pytest.mark.parametrize("place", [(6.0, 0.0), (0.1, -6.3), (12.7, 6.3), (0.1, 6.3)])
def test_a_box_attends_to_the_cells_of_the_whole_map_that_the_network_uses(place: tuple[float, float]) -> None:
    torch.manual_seed(3)
    layer = NeighborhoodAttention(8, heads=2, window=5)
    pixels = torch.randn(1, 32, 32, 8)
    grid = VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 1.0), (0.1, 0.1, 0.1))
    box = torch.tensor([*place, -1, 4, 2, 1.5, 0])
    with torch.no_grad():
        places, weights, edge = pictures._attended(layer, pixels, grid, box)
    assert edge == pytest.approx(0.4) and float(weights.sum()) == pytest.approx(1, abs=1e-5)
    q, k, _ = layer.qkv(pixels).unflatten(-1, (3, 2, 4)).permute(3, 0, 4, 1, 2, 5).unbind(dim=0)
    row, column = int((place[1] + 6.4) / 0.4), int(place[0] / 0.4)
    whole = neighborhood_weights(q, k, layer.bias, 5)[0].mean(dim=0)[row, column]
    assert torch.allclose(weights, whole.reshape(-1), atol=1e-5)
    nearest = (places - torch.tensor(place)).norm(dim=1).min()
    assert float(nearest) < 0.3, "the box's own cell is among them"


def test_location_weights_and_keypoints_are_the_networks() -> None:
    one = detector("kassd", **EVERYTHING)
    with torch.inference_mode():
        predictions = one.predict(Batch.of([FRAME]))
        found = one.model.decode(predictions)[0]
        assert len(found) >= 3
        for k in range(min(3, len(found))):
            places, scores = pictures._keypoints(one.model, predictions, one.grid, found.boxes[k], 0)
            assert places.shape == (one.model.kam.layout.count, 2)
            mean = torch.logit(scores.double()).mean()
            assert float(torch.sigmoid(mean)) == pytest.approx(float(found.scores[k]), abs=1e-3)


def test_the_largest_value_of_a_cell_is_drawn_and_empty_cells_stay_empty() -> None:
    bev = scatter_map(torch.tensor([0.2, 0.9, 0.4]), torch.tensor([0, 0, 1]), torch.tensor([1, 1, 2]), (2, 3))
    assert bev[0, 1] == pytest.approx(0.9) and bev[1, 2] == pytest.approx(0.4) and int(bev.isnan().sum()) == 4


def test_the_command_writes_pictures(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    torch.manual_seed(1)
    save_weights(tmp_path / "h.safetensors", CATALOG["hcnet"].build(SMALL["hcnet"]), {})
    FRAME.points.numpy().tofile(tmp_path / "scan.bin")
    ran = beambox(capsys, "explain", tmp_path / "h.safetensors", tmp_path / "scan.bin", "--out", tmp_path / "out")
    assert ran.status == 0, ran.err
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["scan_channel_weights.png", "scan_height_weights.png", "scan_height_winner.png"]
    assert Image.open(tmp_path / "out" / names[1]).width > 800, "a map of each of the four slices"
