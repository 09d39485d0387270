"""Which anchor answers for which object (SECOND, section 3.2; the public toolbox's axis-aligned assigner)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from beambox.geometry.boxes import axis_aligned_bev
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import AnchorClass, AnchorGrid

__all__ = ["Assignment", "assign"]

TIE = 1e-6
"""Overlaps closer than this are equal: a small box inside several anchors overlaps them alike but for rounding."""


@dataclass(frozen=True)
class Assignment:
    """Targets of the anchors of one sample."""

    label: Tensor
    """``(N,)`` int64: -1 ignored, 0 background, c + 1 for an object of class c."""
    gt_index: Tensor
    """``(N,)`` int64: position of the anchor's object where ``label > 0``, 0 elsewhere."""

    @property
    def positive(self) -> Tensor:
        """``(N,)`` bool."""
        return self.label > 0


def _near_pairs(anchors: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the pairs (anchor, box) whose nearest axis-aligned rectangles overlap, and their IoU.

    Anchors stand on a lattice ``(ny, nx, R, 7)``: which rows and columns a box reaches is found per axis, so that the
    cost grows with the boxes' area and not with the map.
    """
    _, nx, rotations, _ = anchors.shape
    rectangles = axis_aligned_bev(anchors[0, 0])  # (R, 4) around the first cell; the others are its translations
    half = (rectangles[:, 2:] - rectangles[:, :2]) / 2  # (R, 2) x, y
    targets = axis_aligned_bev(boxes)  # (M, 4)
    xs, ys = anchors[0, :, 0, 0], anchors[:, 0, 0, 1]

    def overlap(positions: Tensor, axis: int) -> Tensor:  # (R, M, positions)
        low = torch.maximum(positions - half[:, None, None, axis], targets[:, None, axis])
        high = torch.minimum(positions + half[:, None, None, axis], targets[:, None, axis + 2])
        return (high - low).clamp(min=0)

    along_x, along_y = overlap(xs, 0), overlap(ys, 1)
    rotation, box, row = torch.nonzero(along_y, as_tuple=True)
    columns = along_x[rotation, box]  # (P, nx)
    pair, column = torch.nonzero(columns, as_tuple=True)
    rotation, box, row = rotation[pair], box[pair], row[pair]
    shared = along_x[rotation, box, column] * along_y[rotation, box, row]
    area = 4 * half[rotation].prod(dim=1) + (targets[box, 2:] - targets[box, :2]).prod(dim=1)
    return (row * nx + column) * rotations + rotation, box, shared / (area - shared).clamp(min=1e-6)


def _assign_class(anchors: Tensor, boxes: Tensor, anchor_class: AnchorClass) -> tuple[Tensor, Tensor]:
    """Assign the anchors of one class: ``(N,)`` int64 in {-1, 0, 1} and ``(N,)`` position of the box."""
    count = anchors.shape[:3].numel()
    anchor, box, iou = _near_pairs(anchors, boxes)
    best = iou.new_zeros(count).scatter_reduce_(0, anchor, iou, "amax")
    best_of_box = iou.new_zeros(len(boxes)).scatter_reduce_(0, box, iou, "amax")
    # The first box wins where an anchor overlaps several equally.
    winner = torch.where(iou >= best[anchor] - TIE, box, len(boxes))
    chosen = box.new_full((count,), len(boxes)).scatter_reduce_(0, anchor, winner, "amin") % max(1, len(boxes))
    label = torch.full((count,), -1, device=anchors.device)
    label[best < anchor_class.unmatched_threshold] = 0
    label[best >= anchor_class.matched_threshold] = 1
    label[anchor[iou >= best_of_box[box] - TIE]] = 1  # each box keeps its best anchors, however small the overlap
    return label, torch.where(label > 0, chosen, 0)


def assign(grid: AnchorGrid, region: VoxelGrid, anchors: Tensor, boxes: Tensor, classes: Tensor) -> Assignment:
    """Assign anchors to the objects of one sample, each class for itself.

    The overlap is that of the nearest axis-aligned rectangles in BEV. An anchor is positive from the class's
    ``matched_threshold`` on, and in any case if it is the best one of some object; negative below
    ``unmatched_threshold``; in between it is ignored. Objects whose centre lies outside the region are nobody's
    target: anchors that overlap them as much as a target's would are ignored too.

    Args:
        grid: what the anchors are made of.
        region: the part of space the anchors cover.
        anchors: ``(N, 7)``, :meth:`AnchorGrid.boxes` of that region.
        boxes: ``(M, 7)`` objects.
        classes: ``(M,)`` int64 position of each object's class in ``grid.classes``; others are passed over.
    """
    ny, nx = grid.map_size(region)
    num_rotations = grid.per_cell // len(grid.classes)
    lattice = anchors.reshape(ny, nx, len(grid.classes), num_rotations, 7)
    label = torch.zeros(lattice.shape[:-1], dtype=torch.int64, device=anchors.device)
    gt_index = torch.zeros_like(label)
    inside = region.contains(boxes)
    for k, anchor_class in enumerate(grid.classes):
        members = torch.nonzero((classes == k) & inside)[:, 0]
        if len(members):
            own, chosen = _assign_class(lattice[:, :, k], boxes[members], anchor_class)
            label[:, :, k] = torch.where(own > 0, k + 1, own).reshape(ny, nx, num_rotations)
            gt_index[:, :, k] = members[chosen].reshape(ny, nx, num_rotations)
        outside_objects = boxes[(classes == k) & ~inside]
        if len(outside_objects):
            near, _, iou = _near_pairs(lattice[:, :, k], outside_objects)
            own = label[:, :, k].reshape(-1)
            touched = near[iou >= anchor_class.unmatched_threshold]
            own[touched[own[touched] == 0]] = -1
            label[:, :, k] = own.reshape(ny, nx, num_rotations)
    return Assignment(label.reshape(-1), gt_index.reshape(-1))
