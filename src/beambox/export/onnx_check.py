"""Whether an exported file computes in onnxruntime what the network computes in PyTorch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beambox.checks import BeamboxError, MissingFileError, import_library
from beambox.detectors.kassd import KamScore, KASSDPredictions
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
    "outputs_of",
    "read_about",
    "runtime_is_there",
    "synthetic_sweep",
    "verify",
]

TOLERANCE = 1e-4
"""Largest difference allowed: of scores; of angles in radians; of metres, relative above one metre.

Both compute in float32 and add in another order, which shows in the sixth or seventh digit; an operator that means
something else shows in the first three."""


MOST_TURNED = 0.02
"""Share of the boxes that rounding may turn."""


@dataclass(frozen=True)
class Differences:
    """What onnxruntime and PyTorch differ by on a sweep, over all rows of the outputs."""

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


def outputs_of(config: Any, predictions: AnchorPredictions | KASSDPredictions) -> tuple[Tensor, Tensor]:
    """Turn what a network says of one sweep into the outputs of its file.

    Args:
        config: of the network.
        predictions: of one sweep.

    Returns:
        Boxes ``(A, 7)`` and scores ``(A, K)``, one row per anchor; of KASSD with KAM, one row per box that KAM scores,
        0 for other classes than the box's, and 0 where a row is none.
    """
    if not isinstance(predictions, KASSDPredictions):
        return predictions.decoded()[0], torch.sigmoid(predictions.cls[0])
    found, head = predictions.candidates, predictions.head
    if found is None or predictions.scores is None:
        return outputs_of(config, head)
    score = torch.sigmoid(predictions.scores.float())
    if config.kam_options.score is KamScore.MULTIPLY:
        score = score * found.cls
    if found.valid is not None:
        score = torch.where(found.valid, score, 0)
    scores = score.new_zeros(score.shape[0], head.cls.shape[2]).scatter(1, found.classes[:, None], score[:, None])
    return found.boxes, scores


def verify(path: str | Path, model: Any, points: Tensor) -> Differences:
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


def compare(content: bytes, model: Any, points: Tensor, sweep: str) -> Differences:
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
        wanted, wanted_scores = outputs_of(model.config, predictions)
        chosen = isinstance(predictions, KASSDPredictions) and predictions.candidates is not None
        if scores.shape[1:] != wanted_scores.shape[1:] or not (chosen or boxes.shape == wanted.shape):
            raise BeamboxError(
                f"the file gives boxes {tuple(boxes.shape)} and scores {tuple(scores.shape)}, the network "
                f"{tuple(wanted.shape)} and {tuple(wanted_scores.shape)}: it is of another network"
            )
        if chosen:
            by_score, by_box, turned = chosen_differences(boxes, scores, wanted, wanted_scores)
        else:
            head = predictions.head if isinstance(predictions, KASSDPredictions) else predictions
            apart, half_turns = box_differences(boxes, wanted, head.direction[0])
            by_score, by_box = float((scores - wanted_scores).abs().max()), float(apart.max())
            turned = int(half_turns.sum())
    return Differences(sweep, len(voxels.points), len(voxels), by_score, by_box, turned)


def chosen_differences(
    boxes: Tensor, scores: Tensor, wanted: Tensor, wanted_scores: Tensor
) -> tuple[float, float, int]:
    """Compare the boxes that KAM scores, which both sides choose and order by scores that differ in the last digits.

    Each box of the network is compared with the nearest of its class in the file, and the other way round, so that none
    is missing on either side. KAM reads its maps around the box as it heads, so that a box that rounding turned has
    another score: such boxes are counted and not compared.

    Args:
        boxes: ``(A, 7)`` of the file.
        scores: ``(A, K)`` of the file; rows of zeros are none.
        wanted: ``(M, 7)`` of the network.
        wanted_scores: ``(M, K)`` of the network.

    Returns:
        The largest difference of a score, that of a box as :data:`TOLERANCE` measures it, and the boxes left out.
    """
    there, wanted_there = scores.amax(dim=1) > 0, wanted_scores.amax(dim=1) > 0
    boxes, scores, wanted, wanted_scores = (
        boxes[there],
        scores[there],
        wanted[wanted_there],
        wanted_scores[wanted_there],
    )
    if not len(boxes) or not len(wanted):
        return (0.0, 0.0, 0) if len(boxes) == len(wanted) else (1.0, math.inf, 0)
    lengths = (boxes[None, :, :6] - wanted[:, None, :6]).abs() / wanted[:, None, :6].abs().clamp(min=1)
    angle = wrap_angle(boxes[None, :, 6] - wanted[:, None, 6]).abs()  # (M, A)
    apart = torch.maximum(lengths.amax(dim=2), torch.minimum(angle, math.pi - angle))
    apart = torch.where(scores.argmax(dim=1) == wanted_scores.argmax(dim=1)[:, None], apart, math.inf)
    nearest = apart.argmin(dim=1)  # (M,)
    turned = angle.gather(1, nearest[:, None])[:, 0] > math.pi / 2
    if int(turned.sum()) > max(1, MOST_TURNED * len(turned)):
        return 1.0, math.inf, int(turned.sum())
    by_score = (scores[nearest] - wanted_scores).abs().amax(dim=1)[~turned]
    by_box = max(float(apart.amin(dim=1).max()), float(apart.amin(dim=0).max()))
    return float(by_score.max()) if len(by_score) else 0.0, by_box, int(turned.sum())


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
    onnxruntime = import_library("onnxruntime", "export", "comparing")
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
