"""A detector as one ONNX file: points gathered into voxels in, boxes and scores of all anchors out.

Gathering and post-processing stay outside; what they need stands in the file's metadata (``docs/export.md``). Detectors
made of dense layers can be exported; sparse convolutions have no operator in ONNX.
"""

from __future__ import annotations

import copy
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from beambox import __version__
from beambox.checks import BeamboxError, how_to_install
from beambox.detectors.catalog import config_to_dict, name_of
from beambox.detectors.hcnet import HCNet
from beambox.detectors.pointpillars import PointPillars
from beambox.export.onnx_check import TOLERANCE, Differences, compare, runtime_is_there, synthetic_sweep
from beambox.geometry.grid import VoxelGrid
from beambox.io import write_bytes
from beambox.ops.voxelize import Voxels

__all__ = ["OPSETS", "DenseGraph", "Written", "export_onnx"]

OPSETS = range(18, 24)
"""Versions of ONNX's operators that can be asked for; before 18 there is no maximum over groups."""
FORMAT = "beambox-onnx-1"
INSTALL = how_to_install("export")


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


class DenseGraph(nn.Module):
    """What the file computes: one sweep's points, already gathered into voxels, to decoded boxes and scores."""

    def __init__(self, detector: PointPillars | HCNet, grid: VoxelGrid) -> None:
        super().__init__()
        self.detector = detector
        self.grid = grid
        self.register_buffer("anchors", detector.anchors.boxes(grid))

    def forward(self, points: Tensor, voxel: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """Predict.

        Args:
            points: ``(N, columns)`` float32 points of the region, x, y, z in metres.
            voxel: ``(N,)`` int64 row of ``index`` that each point belongs to.
            index: ``(V, 3)`` int64 cells (z, y, x), each once.

        Returns:
            ``(A, 7)`` boxes in metres and radians and ``(A, K)`` scores, one row an anchor.
        """
        count = torch.zeros_like(voxel[:1]).expand(index.shape[0]).scatter_add(0, voxel, torch.ones_like(voxel))
        of_sample = torch.cat((torch.zeros_like(index[:, :1]), index), dim=1)  # (V, 4) sample 0, z, y, x
        predictions = self.detector.from_voxels(Voxels(points, voxel, count, of_sample, 1, self.grid))
        decoded = replace(predictions, anchors=self.anchors).decoded()  # stored ones, or the graph would make them anew
        return decoded[0], torch.sigmoid(predictions.cls[0])


def export_onnx(
    model: nn.Module,
    path: str | Path,
    *,
    grid: VoxelGrid | None = None,
    opset: int = OPSETS[0],
    card: Mapping[str, Any] | None = None,
    sweeps: Mapping[str, Tensor] | None = None,
) -> Written:
    """Write a detector as an ONNX file, after onnxruntime has computed from it what PyTorch computes.

    Args:
        model: PointPillars or HCNet; it is copied, not changed.
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
    missing = [name for name in ("onnx", "onnxscript") if find_spec(name) is None]
    if missing:
        raise BeamboxError(f"exporting needs {' and '.join(missing)}: {INSTALL}")
    if sweeps and not runtime_is_there():
        raise BeamboxError(f"comparing needs onnxruntime: {INSTALL}")
    proto = traced(DenseGraph(detector, grid or detector.config.grid).eval(), opset)
    about = json.dumps(described(detector, grid or detector.config.grid, card or {}), sort_keys=True)
    proto.metadata_props.add(key="beambox", value=about)
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


def exportable(model: nn.Module) -> PointPillars | HCNet:
    """Return a float32 copy on the CPU, in evaluation mode; refuse what ONNX has no operators for."""
    if not isinstance(model, PointPillars | HCNet):
        raise BeamboxError(
            f"{name_of(model)} cannot be exported: ONNX has no operator for its sparse convolutions; "
            "pointpillars and hcnet can be"
        )
    return copy.deepcopy(model).cpu().float().eval()


def traced(graph: DenseGraph, opset: int) -> Any:
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


def described(detector: PointPillars | HCNet, grid: VoxelGrid, card: Mapping[str, Any]) -> dict[str, Any]:
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
