"""A detector as one ONNX file: points gathered into voxels in, boxes and scores of all anchors out.

Gathering and post-processing stay outside; what they need stands in the file's metadata (``docs/export.md``). Sparse
convolutions, which ONNX has no operator for, become gathers and matrix products (:mod:`beambox.ops.sparse_conv.graph`).
Detectors with one stage can be exported.
"""

from __future__ import annotations

import copy
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from beambox import __version__
from beambox.checks import BeamboxError, lacking
from beambox.detectors.catalog import config_to_dict, name_of
from beambox.detectors.contract import AnyModel
from beambox.detectors.hcnet import HCNet
from beambox.detectors.kassd import KASSD
from beambox.detectors.pointpillars import PointPillars
from beambox.detectors.second import SECOND
from beambox.export.onnx_check import TOLERANCE, Differences, compare, outputs_of, runtime_is_there, synthetic_sweep
from beambox.geometry.grid import VoxelGrid
from beambox.io import write_bytes
from beambox.layers.anchors import AnchorGrid
from beambox.layers.sparse import SparseBlock
from beambox.ops.voxelize import Voxels

__all__ = ["OPSETS", "Exportable", "ExportedGraph", "Written", "export_onnx"]

Exportable = PointPillars | HCNet | SECOND | KASSD

OPSETS = range(18, 24)
"""Versions of ONNX's operators that can be asked for; before 18 there is no maximum over groups."""
FORMAT = "beambox-onnx-1"


@dataclass(frozen=True)
class Written:
    """What was written."""

    path: Path
    """The file."""
    size: int
    """Its length in bytes."""
    inputs: dict[str, str]
    """Name of each input -> shape and element type."""
    outputs: dict[str, str]
    """Name of each output -> shape and element type."""
    checks: tuple[Differences, ...]
    """What onnxruntime and PyTorch differ by, sweep by sweep; empty where onnxruntime is not installed."""


class StoredAnchors(nn.Module):
    """Anchors of one region as numbers, in place of an :class:`AnchorGrid`: the graph would make them anew."""

    def __init__(self, anchors: AnchorGrid, grid: VoxelGrid) -> None:
        super().__init__()
        self.register_buffer("stored", anchors.boxes(grid))

    def boxes(self, grid: VoxelGrid, device: torch.device | None = None) -> Tensor:
        """Return the anchors ``(A, 7)``."""
        stored = self.stored
        assert isinstance(stored, Tensor)
        return stored


class ExportedGraph(nn.Module):
    """What the file computes: one sweep's points, already gathered into voxels, to decoded boxes and scores."""

    def __init__(self, detector: Exportable, grid: VoxelGrid) -> None:
        super().__init__()
        self.detector = copy.deepcopy(detector)
        self.detector.head.anchors = StoredAnchors(detector.anchors, grid)  # pyright: ignore[reportAttributeAccessIssue]
        for block in self.detector.modules():
            if isinstance(block, SparseBlock):
                block.fold()
        self.grid = grid

    def forward(self, points: Tensor, voxel: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """Predict.

        Args:
            points: ``(N, columns)`` float32 points of the region, x, y, z in metres.
            voxel: ``(N,)`` int64 row of ``index`` that each point belongs to.
            index: ``(V, 3)`` int64 cells (z, y, x), each once.

        Returns:
            ``(A, 7)`` boxes in metres and radians and ``(A, K)`` scores, one row per anchor; of KASSD with KAM one
            row per box that KAM scores.
        """
        count = torch.zeros_like(voxel[:1]).expand(index.shape[0]).scatter_add(0, voxel, torch.ones_like(voxel))
        of_sample = torch.cat((torch.zeros_like(index[:, :1]), index), dim=1)  # (V, 4) sample 0, z, y, x
        predictions = self.detector.from_voxels(Voxels(points, voxel, count, of_sample, 1, self.grid))
        return outputs_of(self.detector.config, predictions)


def export_onnx(
    model: AnyModel,
    path: str | Path,
    *,
    grid: VoxelGrid | None = None,
    opset: int = OPSETS[0],
    card: Mapping[str, Any] | None = None,
    sweeps: Mapping[str, Tensor] | None = None,
) -> Written:
    """Write a detector as an ONNX file, after onnxruntime has computed from it what PyTorch computes.

    Args:
        model: PointPillars, HCNet, SECOND or KASSD; it is copied, not changed.
        path: file to write, ending in .onnx.
        grid: the region the file looks at, with cells of the model's size; the model's own where None.
        opset: version of ONNX's operators, one of :data:`OPSETS`.
        card: what is known of the weights, for the metadata.
        sweeps: name -> ``(N, columns or more)`` points in the model's frame to compare on, besides the built-in sweep.

    Raises:
        BeamboxError: if the model cannot be exported, a package is missing, the file cannot be written, or the two
            differ by more than :data:`~beambox.export.onnx_check.TOLERANCE`; nothing is written then.
    """
    path = Path(path)
    detector = exportable(model)
    if path.suffix.lower() != ".onnx":
        raise BeamboxError(f"the file to write must end in .onnx, got {path}")
    if opset not in OPSETS:
        raise BeamboxError(f"`opset` must lie in {OPSETS[0]} .. {OPSETS[-1]}, got {opset}")
    for name in ("onnx", "onnxscript"):
        if find_spec(name) is None:
            raise lacking(name, "export", "exporting")
    if sweeps and not runtime_is_there():
        raise lacking("onnxruntime", "export", "comparing")
    proto = traced(ExportedGraph(detector, grid or detector.config.grid).eval(), opset)
    about = described(detector, grid or detector.config.grid, card or {})
    proto.metadata_props.add(key="beambox", value=json.dumps(about, sort_keys=True))
    proto.metadata_props.add(key="beambox-plain", value=plain(about))
    content = proto.SerializeToString()
    checks = []
    if runtime_is_there():
        everything = {
            "built-in sweep": synthetic_sweep(grid or detector.config.grid, detector.config.num_point_features)
        }
        for name, points in {**everything, **(sweeps or {})}.items():
            checks.append(compare(content, detector, points, name))
            expect_agreement(checks[-1])
    write_bytes(path, content, sync=True)
    return Written(path, len(content), shapes(proto.graph.input), shapes(proto.graph.output), tuple(checks))


def exportable(model: AnyModel) -> Exportable:
    """Return a float32 copy on the CPU, in evaluation mode; refuse detectors with two stages."""
    if not isinstance(model, Exportable):
        raise BeamboxError(
            f"{name_of(model)} cannot be exported: its second stage starts from suppressed boxes, and ONNX has no "
            "operator that suppresses rotated ones; pointpillars, hcnet, second and kassd can be"
        )
    return copy.deepcopy(model).cpu().float().eval()


def traced(graph: ExportedGraph, opset: int) -> Any:
    """Trace a graph into an ``onnx.ModelProto`` with any number of points and voxels, weights inside."""
    count, cells = torch.export.Dim("N"), torch.export.Dim("V")
    example = (
        torch.zeros(5, graph.detector.config.num_point_features),
        torch.tensor([0, 0, 1, 1, 2]),
        torch.tensor([[0, 0, 0], [0, 0, 1], [0, 1, 1]]),
    )
    with quiet(), torch.no_grad():
        program = torch.onnx.export(
            graph,
            example,
            input_names=["points", "voxel", "index"],
            output_names=["boxes", "scores"],
            dynamic_shapes={"points": {0: count}, "voxel": {0: count}, "index": {0: cells}},
            opset_version=opset,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    for part in (proto, proto.graph, *proto.graph.node, *proto.graph.input, *proto.graph.output, *proto.functions):
        del part.metadata_props[:]  # the exporter leaves traces of the source there, with this machine's paths
        part.doc_string = ""
    del proto.graph.value_info[:]
    proto.producer_name, proto.producer_version = "beambox", __version__
    return proto


@contextmanager
def quiet() -> Iterator[None]:
    """Keep the exporter's remarks on its own parts from the user."""
    logger = logging.getLogger("torch.onnx._internal.exporter._registration")  # on operators of torchvision
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def described(detector: Exportable, grid: VoxelGrid, card: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the file's metadata say: everything that gathering and post-processing need."""
    config = detector.config
    return {
        "format": FORMAT,
        "beambox": __version__,
        "detector": name_of(detector),
        "classes": list(config.classes),
        "columns": config.num_point_features,
        "grid": asdict(grid),
        "cells": list(grid.size),
        "max_points": config.max_points,
        "max_voxels": config.max_voxels,
        "post": asdict(config.post),
        "config": config_to_dict(config),
        "card": dict(card),
    }


def plain(about: Mapping[str, Any]) -> str:
    """Write what running the file needs as lines of words, for programs without a JSON library; 0 is no limit."""
    grid, post = about["grid"], about["post"]
    values = {
        "columns": [about["columns"]],
        "minimum": grid["minimum"],
        "cell": grid["cell"],
        "cells": about["cells"],
        "max_points": [about["max_points"] or 0],
        "max_voxels": [about["max_voxels"] or 0],
        **{key: [post[key]] for key in ("score_threshold", "nms_iou", "nms_pre", "nms_post")},
    }
    lines = [f"class {' '.join(name.split())}" for name in about["classes"]]
    lines += [f"{key} {' '.join(map(str, row))}" for key, row in values.items()]
    return "\n".join(lines) + "\n"


def expect_agreement(found: Differences) -> None:
    """Refuse a file that computes something else than the network."""
    if not found.agree:
        raise BeamboxError(
            f"onnxruntime and PyTorch differ on {found.sweep}: scores by {found.scores:.1e}, boxes by "
            f"{found.boxes:.1e}, allowed are {TOLERANCE:.0e}; nothing was written"
        )


def shapes(values: Any) -> dict[str, str]:
    """Write the shapes and types of a graph's inputs or outputs."""
    import onnx

    signature = {}
    for value in values:
        tensor = value.type.tensor_type
        sizes = ", ".join(dim.dim_param or str(dim.dim_value) for dim in tensor.shape.dim)
        kind = onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type).name
        signature[value.name] = f"({sizes}) {kind}"
    return signature
