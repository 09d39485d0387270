"""Whether an exported file computes in onnxruntime what the network computes in PyTorch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beambox.checks import BeamboxError, MissingFileError, how_to_install
from beambox.detectors.contract import DetectorModel
from beambox.geometry.boxes import wrap_angle
from beambox.geometry.grid import VoxelGrid
from beambox.io import parse_json
from beambox.layers.coders import DIRECTION_OFFSET
from beambox.layers.heads import AnchorPredictions
from beambox.ops.voxelize import Voxels, voxelize
from beambox.structures.batch import Batch

__all__ = [
    "TOLERANCE",
    "Differences",
    "compare",
    "gathered",
    "read_about",
    "runtime_is_there",
    "synthetic_sweep",
    "verify",
]

TOLERANCE = 1e-4
"""Largest difference allowed: of scores; of angles in radians; of metres, relative above one metre.

Both compute in float32 and add in another order, which shows in the sixth or seventh digit; an operator that means
something else shows in the first three."""


@dataclass(frozen=True)
class Differences:
    """What onnxruntime and PyTorch differ by on a sweep, over all anchors."""

    sweep: str
    """Name of the sweep."""
    points: int
    """Points that entered the network."""
    voxels: int
    """Voxels they were gathered into."""
    scores: float
    """Largest difference of a score."""
    boxes: float
    """Largest difference of a box's numbers, measured as :data:`TOLERANCE` says."""
    half_turns: int
    """Boxes that head the other way because PyTorch's own choice hangs on rounding; they are not in ``boxes``."""

    @property
    def agree(self) -> bool:
        """Whether nothing differs by more than is allowed; NaN never agrees."""
        return self.scores <= TOLERANCE and self.boxes <= TOLERANCE


def runtime_is_there() -> bool:
    """Tell whether onnxruntime is installed."""
    return find_spec("onnxruntime") is not None


def verify(path: str | Path, model: DetectorModel[AnchorPredictions], points: Tensor) -> Differences:
    """Compare a written file with the network it was made from.

    Args:
        path: the .onnx file.
        model: the network, in evaluation mode, float32, on the CPU.
        points: ``(N, columns or more)`` float32 in the model's frame.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: if it is no file of :func:`beambox.export.onnx_file.export_onnx`, or no point lies in its region.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"no file {path}; `beambox export` writes one")
    return compare(path.read_bytes(), model, points, path.name)


def compare(content: bytes, model: DetectorModel[AnchorPredictions], points: Tensor, sweep: str) -> Differences:
    """Run a file's content and the network on the same points; the file is fed by what its own metadata say."""
    session = opened(content)
    about = read_about(session)
    voxels = gathered(about, points)
    if not len(voxels):
        raise BeamboxError(
            f"{sweep}: none of its {len(points)} points lies in the region of the file; give another sweep"
        )
    inputs = {"points": voxels.points, "voxel": voxels.voxel, "index": voxels.index[:, 1:]}
    got = session.run(["boxes", "scores"], {name: value.contiguous().numpy() for name, value in inputs.items()})
    boxes, scores = (torch.from_numpy(array) for array in got)
    sample = torch.zeros(len(points), dtype=torch.int64)
    with torch.inference_mode():
        predictions = model(Batch(points, sample, 1), voxels.grid)
        wanted, wanted_scores = predictions.decoded()[0], torch.sigmoid(predictions.cls[0])
        if boxes.shape != wanted.shape or scores.shape != wanted_scores.shape:
            raise BeamboxError(
                f"the file gives boxes {tuple(boxes.shape)} and scores {tuple(scores.shape)}, the network "
                f"{tuple(wanted.shape)} and {tuple(wanted_scores.shape)}: it is of another network"
            )
        apart, turned = box_differences(boxes, wanted, predictions.direction[0])
        by_score = (scores - wanted_scores).abs().max()
    return Differences(sweep, len(voxels.points), len(voxels), float(by_score), float(apart.max()), int(turned.sum()))


def box_differences(boxes: Tensor, wanted: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Compare boxes as :data:`TOLERANCE` measures them.

    A heading jumps by half a turn where the two direction logits tie, and where it lies on the border between the two
    half turns. There, and only there, another half turn counts as the same heading.

    Args:
        boxes: ``(A, 7)`` of the file.
        wanted: ``(A, 7)`` of the network.
        direction: ``(A, 2)`` the network's direction logits.

    Returns:
        ``(A, 7)`` differences, and ``(A,)`` bool, those that head the other way.
    """
    lengths = (boxes[:, :6] - wanted[:, :6]).abs() / wanted[:, :6].abs().clamp(min=1)
    angle = wrap_angle(boxes[:, 6] - wanted[:, 6]).abs()
    into = wrap_angle(wanted[:, 6] - DIRECTION_OFFSET, 0.0, math.pi)  # from the border between the half turns
    border = torch.minimum(into, math.pi - into) < TOLERANCE
    tie = (direction[:, 0] - direction[:, 1]).abs() < TOLERANCE * direction.abs().amax(dim=1).clamp(min=1)
    turned = (angle > math.pi / 2) & (tie | border)
    angle = torch.where(turned, math.pi - angle, angle)
    return torch.cat((lengths, angle[:, None]), dim=1), turned


def opened(content: bytes) -> Any:
    """Open a file's content in onnxruntime, on the CPU."""
    if not runtime_is_there():
        raise BeamboxError(f"comparing needs onnxruntime: {how_to_install('export')}")
    import onnxruntime
    from onnxruntime.capi.onnxruntime_pybind11_state import Fail, InvalidGraph, InvalidProtobuf, NotImplemented

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors only
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except (Fail, InvalidGraph, InvalidProtobuf, NotImplemented) as error:
        raise BeamboxError(f"onnxruntime {onnxruntime.__version__} cannot open the file: {error}") from error


def read_about(session: Any) -> dict[str, Any]:
    """Return what a file says of itself in its metadata; ``session`` is an ``onnxruntime.InferenceSession``."""
    metadata = session.get_modelmeta().custom_metadata_map
    if "beambox" not in metadata:
        raise BeamboxError(
            f'expected a file that beambox exported, with "beambox" in its metadata, got {sorted(metadata)}'
        )
    return parse_json(metadata["beambox"], "its metadata")


def gathered(about: dict[str, Any], points: Tensor) -> Voxels:
    """Gather ``(N, columns or more)`` points into voxels as a file's metadata ask for."""
    sample = torch.zeros(len(points), dtype=torch.int64)
    grid = VoxelGrid(**{key: tuple(value) for key, value in about["grid"].items()})
    return voxelize(points[:, : about["columns"]], sample, 1, grid, about["max_points"], about["max_voxels"])


def synthetic_sweep(grid: VoxelGrid, columns: int = 4, seed: int = 0) -> Tensor:
    """Return ``(2000, columns)`` float32 points in clumps all over a region, always the same."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(grid.minimum), torch.tensor(grid.maximum)
    middles = low + (high - low) * torch.rand(100, 3, generator=generator)
    clumps = middles[:, None] + 0.3 * torch.randn(100, 20, 3, generator=generator)  # a few points in each cell
    features = torch.rand(2000, columns - 3, generator=generator)
    inside = torch.minimum(torch.maximum(clumps.reshape(-1, 3), low), high)  # those on the upper border are dropped
    return torch.cat((inside, features), dim=1)
