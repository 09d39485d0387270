"""Every detector of the catalogue, small enough that a pass takes milliseconds, and sweeps for them to look at."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from beambox.detectors.catalog import CATALOG
from beambox.detectors.dennet import AttentionPosition, CountSet, DenNetConfig, Normalization
from beambox.detectors.hcnet import Gate, HCNetConfig, HeightChannelKind
from beambox.detectors.kassd import KamOptions, KASSDConfig, KASSDPredictions, Neck
from beambox.detectors.kassd.keypoints import ExtraPoint, KeypointLayout
from beambox.detectors.pointpillars import PointPillarsConfig
from beambox.detectors.second import KITTI_CAR, SECONDConfig
from beambox.detectors.voxel_rcnn import VoxelRCNNConfig, VoxelRCNNPredictions
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import KITTI_ANCHORS
from beambox.layers.heads import AnchorPredictions
from beambox.layers.roi import NmsConfig, RoiSampling
from beambox.structures import Frame, Labels

CAR = [6.0, 1.0, -1.0, 4.0, 1.7, 1.5, 0.4]
"""A car that lies in every grid."""

POINTPILLARS = PointPillarsConfig(
    anchors=KITTI_ANCHORS[:1],
    grid=VoxelGrid((0, -10.24, -3), (20.48, 10.24, 1), (0.32, 0.32, 4)),
    voxel_channels=8,
    depths=(1, 1, 1),
    widths=(8, 8, 16),
    up_widths=(8, 8, 8),
    centered_anchors=True,
)
HCNET = HCNetConfig(
    grid=VoxelGrid((0, -10.24, -3), (20.48, 10.24, 1), (0.32, 0.32, 1)),
    voxel_channels=8,
    channel_hidden=4,
    depths=(1, 1, 1),
    widths=(8, 8, 16),
    up_widths=(8, 8, 8),
    head_depth=1,
    head_width=16,
    oifm_width=8,
    centered_anchors=True,
)
VOXELS = VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 1.0), (0.1, 0.1, 0.1))
ENCODER: dict[str, Any] = {"encoder_widths": (4, 4, 8, 8), "encoder_out": 8}
SECOND: SECONDConfig = replace(KITTI_CAR, grid=VOXELS, depths=(1, 1), widths=(8, 8), up_widths=(8, 8), **ENCODER)
KASSD_CONFIG = KASSDConfig(grid=VOXELS, width=8, kam_width=8, centered_anchors=True, **ENCODER)
TWO_STAGES: dict[str, Any] = {
    **ENCODER,
    "anchors": KITTI_ANCHORS[:1],
    "depths": (1, 1),
    "widths": (8, 8),
    "up_widths": (8, 8),
    "train_proposals": NmsConfig(200, 20, 0.8),
    "test_proposals": NmsConfig(100, 10, 0.7),
    "sampling": RoiSampling(rois_per_frame=8),
    "grid_size": 2,
    "roi_width": 16,
}
VOXEL_RCNN = VoxelRCNNConfig(grid=VOXELS, **TWO_STAGES)
DENNET = DenNetConfig(
    grid=VoxelGrid((0.0, -6.4, -3.0), (12.8, 6.4, 3.0), (0.2, 0.2, 0.15)),
    density_depth=4,
    na_heads=(1, 2),
    **TWO_STAGES,
)
SMALL: dict[str, Any] = {
    "dennet": DENNET,
    "hcnet": HCNET,
    "kassd": KASSD_CONFIG,
    "pointpillars": POINTPILLARS,
    "second": SECOND,
    "voxel_rcnn": VOXEL_RCNN,
}
VARIANTS: dict[str, Any] = {
    **SMALL,
    "hcnet: HA, no OIFM": replace(HCNET, attention=HeightChannelKind.HEIGHT, oifm=False),
    "hcnet: CA, sigmoid": replace(HCNET, attention=HeightChannelKind.CHANNEL, aam_gate=Gate.SIGMOID),
    "hcnet: plain": replace(HCNET, attention=HeightChannelKind.NONE, aam=False, absolute_xy=False),
    "hcnet: 8 slices, 3 classes": replace(
        HCNET, grid=VoxelGrid((0, -10.24, -3), (20.48, 10.24, 1), (0.32, 0.32, 0.5)), anchors=KITTI_ANCHORS
    ),
    "kassd: baseline": replace(KASSD_CONFIG, llm=False, kam=False),
    "kassd: plain LLM": replace(KASSD_CONFIG, frs_reuse=False, lam=False),
    "kassd: PSA, corners": replace(KASSD_CONFIG, neck=Neck.PSA, keypoints=KeypointLayout(2, 2, 0, 0)),
    "kassd: DenseASPP, inner": replace(KASSD_CONFIG, neck=Neck.DENSEASPP, keypoints=KeypointLayout(0, 0, 6, 3)),
    "kassd: SPP, centre": replace(KASSD_CONFIG, neck=Neck.SPP, keypoints=KeypointLayout(extra_point=ExtraPoint.CENTER)),
    "kassd: SECOND, soft": replace(
        KASSD_CONFIG, neck=Neck.SECOND, kam_options=KamOptions(soft_targets=True, box_gradient=True)
    ),
    "kassd: 3 classes": replace(
        KASSD_CONFIG, anchors=KITTI_ANCHORS, kam_options=KamOptions(positive_iou=(0.7, 0.5, 0.5))
    ),
    "dennet: middle, points": replace(
        DENNET, na_position=AttentionPosition.MIDDLE, na_mlp=False, count_set=CountSet.POINTS, own_points=True
    ),
    "dennet: share, collapsed, no NA": replace(
        DENNET, normalization=Normalization.SHARE, max_count=16, density_collapse=True, na=False
    ),
}
"""The small ones, and others with their switches set; the name before the colon is the catalogue's."""


def build_small(name: str, config: Any = None, seed: int = 0) -> Any:
    """Return a detector with random weights, in training mode; the small one of its name without a configuration."""
    torch.manual_seed(seed)
    return CATALOG[name].build(config or SMALL[name])


def first_stage(predictions: Any) -> AnchorPredictions:
    """Return what the anchors of any detector say."""
    if isinstance(predictions, VoxelRCNNPredictions):
        return predictions.first
    return predictions.head if isinstance(predictions, KASSDPredictions) else predictions


def output_tensors(predictions: Any) -> list[Tensor]:
    """Return the maps of a detector's predictions, ``(B, ...)`` each."""
    first = first_stage(predictions)
    maps = predictions.maps if isinstance(predictions, KASSDPredictions) else None
    return [first.cls, first.box, first.direction, *([] if maps is None else [maps])]


def total(losses: dict[str, Tensor]) -> Tensor:
    """Return the sum of the losses."""
    return torch.stack(list(losses.values())).sum()


def car_frame(seed: int, *boxes: list[float], ground: int = 800, reach: float = 12.0) -> Frame:
    """Return a sweep: ``reach`` metres of flat ground ahead, half as far to either side, and the faces of some cars."""
    generator = torch.Generator().manual_seed(seed)
    road = torch.rand(ground, 4, generator=generator) * torch.tensor([reach, reach, 0.05, 0.3])
    clouds = [road - torch.tensor([0.0, reach / 2, 1.75, 0.0])]
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
