"""Detectors as a GPU runs them, sizes fixed and read once, against the references (see test_triton.py)."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from beambox.layers.heads import PostProcess
from beambox.layers.roi import NmsConfig
from beambox.structures import Batch
from oracles.small_detectors import CAR, SMALL, build_small, car_frame, first_stage, total

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
LOW = PostProcess(score_threshold=0.009, nms_iou=0.1, nms_pre=64, nms_post=12)
"""Random networks are unsure of everything."""


def detector(name):
    config = replace(SMALL[name], post=LOW)
    if hasattr(config, "test_proposals"):
        limits = NmsConfig(60, 4, 0.7)
        config = replace(config, test_proposals=limits, train_proposals=limits)
    if hasattr(config, "kam_options"):
        config = replace(config, kam_options=replace(config.kam_options, threshold=0.009, test_boxes=60))
    model = build_small(name, config)
    for layer in model.modules():
        if isinstance(layer, nn.Dropout):
            layer.p = 0.0
        if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
            layer.momentum = 1.0
    return model


def sweep(seed):
    """A few dozen points: the interpreter takes milliseconds for each program of a kernel."""
    frame = car_frame(seed, CAR, ground=80)
    return frame.with_points(frame.points[::16])


def batch(empty):
    nothing = sweep(2)
    return Batch.of([sweep(1), nothing.with_points(nothing.points[:0]), sweep(3)] if empty else [sweep(1)])


@pytest.mark.parametrize("name", ["pointpillars", "hcnet", "kassd", "dennet"])  # the parts of all
def test_detections_are_those_of_the_references(name, monkeypatch):
    given, model = batch(empty=True), detector(name)
    with torch.no_grad():
        monkeypatch.setenv("BEAMBOX_BACKEND", "reference")
        model.train()(batch(empty=False))  # batch norms see what they will meet
        model.eval()
        expected = model(given)
        want = model.decode(expected)
        monkeypatch.setenv("BEAMBOX_BACKEND", "triton")
        there = model.to(DEVICE)
        predicted = there(given.to(DEVICE))
        actual = there.decode(predicted)
    for part in ("cls", "box", "direction"):
        mine, other = (getattr(first_stage(p), part).cpu() for p in (predicted, expected))
        torch.testing.assert_close(mine, other, rtol=1e-3, atol=1e-4)
    assert max(len(one) for one in want) > 0, "detections of nothing would prove nothing"
    for mine, other in zip(actual, want, strict=True):
        assert mine.boxes.device.type == "cpu"
        torch.testing.assert_close(mine.scores, other.scores, rtol=1e-3, atol=1e-4)
        alone = ((other.scores[:, None] - other.scores).abs() < 1e-4).sum(
            dim=1
        ) == 1  # of equals, either may come first
        torch.testing.assert_close(mine.boxes[alone], other.boxes[alone], rtol=1e-3, atol=1e-3)
        assert mine.class_ids.equal(other.class_ids)


@pytest.mark.parametrize("name", ["voxel_rcnn", "kassd"])
def test_losses_and_gradients_are_those_of_the_references(name, monkeypatch):
    given, model = batch(empty=False), detector(name)
    results = []
    for backend, device in (("reference", "cpu"), ("triton", DEVICE)):
        monkeypatch.setenv("BEAMBOX_BACKEND", backend)
        model.to(device).train().zero_grad()
        torch.manual_seed(3)  # regions are drawn by the CPU's generator
        losses = model.loss(model(given.to(device), labels=given.labels), given.labels)
        total(losses).backward()
        gradients = {key: p.grad.cpu().clone() for key, p in model.named_parameters() if p.grad is not None}
        results.append(({key: value.detach().cpu() for key, value in losses.items()}, gradients))
    (want, theirs), (actual, ours) = results
    torch.testing.assert_close(actual, want, rtol=1e-3, atol=1e-4)
    assert ours.keys() == theirs.keys()
    for key, gradient in theirs.items():
        assert (ours[key] - gradient).norm() <= 2e-2 * gradient.norm() + 1e-4, key
