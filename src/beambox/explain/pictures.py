"""What each detector's own modules weigh: HCNet's slices, KASSD's places and keypoints, DenNet's densities."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from beambox.checks import BeamboxError, expect_library
from beambox.detectors.dennet import DenNet, NeighborhoodAttention
from beambox.detectors.hcnet import HCNet, pillar_stacks
from beambox.detectors.kassd.keypoints import map_coordinates, sample_bilinear
from beambox.detectors.kassd.network import KASSD, KASSDPredictions, LocationAttention, location_weights
from beambox.detectors.second import STRIDE
from beambox.explain.drawing import Explained, draw_bars, draw_maps, draw_near, scatter_map
from beambox.geometry.grid import VoxelGrid
from beambox.infer.predictor import Detector
from beambox.layers.heads import best_anchors
from beambox.ops.neighborhood.reference import neighborhood_weights
from beambox.structures import Batch, Detections, Frame

__all__ = ["explain"]

MOST = 5
"""Detections looked at closely."""


@torch.inference_mode()
def explain(detector: Detector, frame: Frame, score_threshold: float = 0.3) -> list[Explained]:
    """Draw what a detector's attention weighs in a sweep.

    Args:
        detector: HCNet, KASSD or DenNet.
        frame: as given; pictures are in the network's frame.
        score_threshold: detections below are not drawn.

    Raises:
        BeamboxError: for another detector, or a sweep with no point where it looks.
    """
    expect_library("matplotlib", "plots", "drawing what a detector weighs")
    model = detector.model
    if not isinstance(model, HCNet | KASSD | DenNet):
        raise BeamboxError(f"{type(model).__name__} has no attention to draw; HCNet, KASSD and DenNet have")
    prepared = detector.prepare(frame)
    if not detector.sees(prepared):
        raise BeamboxError(f"{frame.id or 'the sweep'} has no point where the network looks; beambox doctor says why")
    batch = Batch.of([prepared]).to(detector.device)
    if isinstance(model, HCNet):
        return list(_hcnet(detector, model, batch, score_threshold))
    if isinstance(model, KASSD):
        return list(_kassd(detector, model, batch, score_threshold))
    return list(_dennet(detector, model, batch, score_threshold))


@contextmanager
def _seen(module: nn.Module) -> Iterator[list[tuple[tuple[Any, ...], Any]]]:
    """Note what goes into a module and what comes out of it."""
    notes: list[tuple[tuple[Any, ...], Any]] = []
    handle = module.register_forward_hook(lambda _, given, made: notes.append((given, made)))
    try:
        yield notes
    finally:
        handle.remove()


def _found(detector: Detector, predictions: object, score_threshold: float) -> Detections:
    """Decode in the network's own frame."""
    found = detector.model.decode(predictions)[0].to("cpu")
    return found[found.scores >= score_threshold]


# ---------------------------------------------------------------- HCNet


def _hcnet(detector: Detector, model: HCNet, batch: Batch, score_threshold: float) -> Iterator[Explained]:
    grid = detector.grid
    boxes = _found(detector, detector.predict(batch), score_threshold).boxes
    voxels = model.voxels(batch, grid)
    stacks, pillars = pillar_stacks(model.voxel_net(voxels), voxels)  # (M, P, C), (M, 4)
    images = stacks.permute(2, 0, 1)[None, :, :, None, :]  # (1, C, M, 1, P): each pillar a pixel
    weights = model.fuse_slices.attention(images)[0, :, :, 0].permute(1, 2, 0).cpu()  # (M, P, C)
    occupied = stacks.amax(dim=2).cpu() > 0  # (M, P)
    rows, columns = pillars[:, 2].cpu(), pillars[:, 3].cpu()
    shape = (grid.size[1], grid.size[0])
    low, step = grid.minimum[2], grid.cell[2]
    maps = []
    for k in range(weights.shape[1]):
        mine = occupied[:, k]
        bev = scatter_map(weights[mine, k].mean(dim=1), rows[mine], columns[mine], shape)
        maps.append((f"z {low + k * step:+.1f} to {low + (k + 1) * step:+.1f} m", bev))
    title = "HCNet: weight of each height slice, mean over the channels (0.5 is the least)"
    yield Explained("height_weights", title, draw_maps(maps, grid, boxes, title))
    winner = (weights * stacks.cpu()).amax(dim=2).argmax(dim=1).float()  # (M,)
    title = "HCNet: the slice that gives a pillar most, counted from the lowest"
    yield Explained(
        "height_winner", title, draw_maps([("slice", scatter_map(winner, rows, columns, shape))], grid, boxes, title)
    )
    series = [
        (f"slice {k}", weights[occupied[:, k], k].mean(dim=0)) for k in range(weights.shape[1]) if occupied[:, k].any()
    ]
    title = "HCNet: weight of each channel, mean over the occupied pillars"
    yield Explained("channel_weights", title, draw_bars(series, title, "channel"))


# ---------------------------------------------------------------- KASSD


def _kassd(detector: Detector, model: KASSD, batch: Batch, score_threshold: float) -> Iterator[Explained]:
    grid = detector.grid
    with _seen(model.neck.levels if isinstance(model.neck, LocationAttention) else model.neck) as notes:
        predictions: KASSDPredictions = detector.predict(batch)
    found = _found(detector, predictions, score_threshold)
    if isinstance(model.neck, LocationAttention) and model.neck.lam:
        high, low = notes[0][1]
        weights = location_weights(high, low, model.neck.reduce)[0, 0].float().cpu()
        title = "KASSD: weight of the higher level at each place (LAM); 1 less is the lower level's"
        yield Explained(
            "location_weights", title, draw_maps([("weight", weights)], grid, found.boxes, title, limits=(0, 1))
        )
    if predictions.maps is None:
        return
    best = torch.sigmoid(predictions.maps[0].float()).amax(dim=0).cpu()
    title = "KASSD: the largest of the keypoints' scores at each place (KAM)"
    yield Explained("keypoint_maps", title, draw_maps([("score", best)], grid, found.boxes, title))
    items = []
    for box, name, score in list(zip(found.boxes, found.names, found.scores.tolist()))[:MOST]:
        places, values = _keypoints(model, predictions, grid, box, model.config.classes.index(name))
        items.append((f"{name} {score:.2f}", box, places.numpy(), values.numpy(), 0.3))
    if items:
        points = batch.points.cpu()
        title = "KASSD: scores of the keypoints of the surest boxes"
        yield Explained("keypoint_scores", title, draw_near(items, points, title, reach=4.0))


def _keypoints(
    model: KASSD, predictions: KASSDPredictions, grid: VoxelGrid, box: Tensor, kind: int
) -> tuple[Tensor, Tensor]:
    """Return where a detection's keypoints lie, ``(K, 2)``, and their scores, ``(K,)``."""
    assert model.kam is not None and predictions.maps is not None
    head, options = predictions.head, model.config.kam_options
    rows, _, _ = best_anchors(head, 0, options.threshold, options.test_boxes)
    mine = (head.decoded_rows(0, rows) - box.to(head.anchors)).square().sum(dim=1).argmin()  # the anchor it came from
    places = model.kam.layout.points(box[None].to(head.anchors), head.anchors[rows[mine], :2][None])  # (1, K, 2)
    at = map_coordinates(places, grid, STRIDE)
    channel = kind * model.kam.layout.count + torch.arange(model.kam.layout.count, device=at.device)[None]
    logits = sample_bilinear(predictions.maps.float(), torch.zeros_like(channel), channel, at)
    return places[0].cpu(), torch.sigmoid(logits[0]).cpu()


# ---------------------------------------------------------------- DenNet


def _dennet(detector: Detector, model: DenNet, batch: Batch, score_threshold: float) -> Iterator[Explained]:
    grid = detector.grid
    attention = [layer for layer in model.modules() if isinstance(layer, NeighborhoodAttention)]
    watched = [*attention, *([model.density] if model.density is not None else [])]
    if not watched:
        raise BeamboxError("this DenNet has neither density nor neighborhood attention (vda and na are off)")
    notes: dict[nn.Module, tuple[Any, ...]] = {}

    def note(module: nn.Module, given: tuple[Any, ...]) -> None:
        notes[module] = given

    handles = [layer.register_forward_pre_hook(note) for layer in watched]
    try:
        predictions = detector.predict(batch)
    finally:
        for handle in handles:
            handle.remove()
    found = _found(detector, predictions, score_threshold)
    if model.density is not None:
        sites, voxels = notes[model.density]
        values = model.density.features(sites, voxels).cpu()  # (V, radii)
        rows, columns = sites.indices[:, 2].cpu(), sites.indices[:, 3].cpu()
        shape = (grid.size[1], grid.size[0])
        names = [f"within {radius:g} m" for radius in model.density.radii]
        names += ["of the voxel itself"] * (values.shape[1] - len(names))
        maps = [(name, scatter_map(values[:, k], rows, columns, shape)) for k, name in enumerate(names)]
        title = f"DenNet: density of each voxel ({model.density.normalization.value}), the largest of each column"
        yield Explained("densities", title, draw_maps(maps, grid, found.boxes, title))
    points = batch.points.cpu()
    for number, layer in enumerate(attention, start=1):
        (pixels,) = notes[layer]
        items = []
        for box, name, score in list(zip(found.boxes, found.names, found.scores.tolist()))[:MOST]:
            places, weights, edge = _attended(layer, pixels, grid, box)
            items.append((f"{name} {score:.2f}", box, places.numpy(), weights.numpy(), edge))
        if items:
            title = f"DenNet: what the middle of the surest boxes attends to, stage {number}, mean over the heads"
            reach = max(4.0, 0.6 * items[0][4] * layer.window)
            yield Explained(f"neighborhood_{number}", title, draw_near(items, points, title, reach=reach))


def _attended(
    layer: NeighborhoodAttention, pixels: Tensor, grid: VoxelGrid, box: Tensor
) -> tuple[Tensor, Tensor, float]:
    """Return places ``(L * L, 2)``, metres, that the cell at a box's middle attends to, weights, a cell's edge."""
    height, width, channels = pixels.shape[1:]
    edge = (grid.maximum[0] - grid.minimum[0]) / width
    column = min(width - 1, max(0, math.floor((float(box[0]) - grid.minimum[0]) / edge)))
    row = min(height - 1, max(0, math.floor((float(box[1]) - grid.minimum[1]) / edge)))
    top, left = (
        max(0, min(at - layer.window, size - 2 * layer.window - 1)) for at, size in ((row, height), (column, width))
    )
    part = pixels[:, top : top + 2 * layer.window + 1, left : left + 2 * layer.window + 1]
    qkv = layer.qkv(part).unflatten(-1, (3, layer.heads, channels // layer.heads))
    q, k, _ = qkv.permute(3, 0, 4, 1, 2, 5).unbind(dim=0)  # each (1, heads, H, W, d)
    weights = neighborhood_weights(q.float(), k.float(), layer.bias.float(), layer.window)[0].mean(
        dim=0
    )  # (H, W, L, L)
    mine = weights[row - top, column - left].cpu()  # (L, L)
    first_row = min(max(row - layer.window // 2, 0), height - layer.window)
    first_column = min(max(column - layer.window // 2, 0), width - layer.window)
    ys = grid.minimum[1] + (first_row + torch.arange(layer.window) + 0.5) * edge
    xs = grid.minimum[0] + (first_column + torch.arange(layer.window) + 0.5) * edge
    places = torch.stack((xs[None].expand(layer.window, -1), ys[:, None].expand(-1, layer.window)), dim=2)
    return places.reshape(-1, 2), mine.reshape(-1), edge
