"""Checkpoints of OpenPCDet, read into this package's detectors.

Only tensors and NumPy's numbers are read (``torch.load(weights_only=True)``), never code. A checkpoint does not say
what it was trained for, so its configuration is told from the number of classes its head has: 1 for KITTI's cars, 3 for
KITTI, 5 for ONCE.
"""

from __future__ import annotations

import pickle
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beambox.checks import BeamboxError, MissingFileError, did_you_mean, printable
from beambox.detectors.contract import AnyModel, DetectorConfig, module_of
from beambox.detectors.pointpillars import PointPillarsConfig, pointpillars
from beambox.detectors.second import KITTI_CAR, SECONDConfig, second
from beambox.detectors.second import ONCE as SECOND_ONCE
from beambox.detectors.voxel_rcnn import KITTI as VOXEL_RCNN_KITTI
from beambox.detectors.voxel_rcnn import ONCE as VOXEL_RCNN_ONCE
from beambox.detectors.voxel_rcnn import VoxelRCNNConfig, voxel_rcnn
from beambox.geometry.grid import VoxelGrid
from beambox.layers.anchors import ONCE_ANCHORS

__all__ = ["MODELS", "import_checkpoint", "read_checkpoint"]

Names = Iterator[tuple[str, str]]


# --- the table of names: (layer here, layer there) --------------------------------------------------------------------


def pointpillars_names(config: PointPillarsConfig) -> Names:
    """Name PointPillars's layers."""
    yield "pillar_net.linear", "vfe.pfn_layers.0.linear"
    yield "pillar_net.norm", "vfe.pfn_layers.0.norm"
    yield from bev_names(config.depths)
    yield from head_names()


def second_names(config: SECONDConfig) -> Names:
    """Name SECOND's layers."""
    yield from encoder_names()
    yield from bev_names(config.depths)
    yield from head_names()


def voxel_rcnn_names(config: VoxelRCNNConfig) -> Names:
    """Name Voxel R-CNN's layers; 1 x 1 convolutions over points there are linear layers here."""
    yield from encoder_names()
    yield from bev_names(config.depths)
    yield from head_names()
    for level in range(len(config.pooling)):
        for ours, theirs in (("feature", "mlps_in"), ("offset", "mlps_pos"), ("out", "mlps_out")):
            yield f"roi_pool.levels.{level}.{ours}", f"roi_head.roi_grid_pool_layers.{level}.{theirs}.0.0"
            yield f"roi_pool.levels.{level}.{ours}_norm", f"roi_head.roi_grid_pool_layers.{level}.{theirs}.0.1"
    for ours, theirs in (
        ("shared", "shared_fc_layer"),
        ("cls_layers", "cls_fc_layers"),
        ("box_layers", "reg_fc_layers"),
    ):
        for layer in (0, 1, 4, 5):
            yield f"roi_head.{ours}.{layer}", f"roi_head.{theirs}.{layer}"
    yield "roi_head.cls", "roi_head.cls_pred_layer"
    yield "roi_head.box", "roi_head.reg_pred_layer"


def encoder_names() -> Names:
    """Name the sparse encoder's layers; each stage's first convolution is the strided one."""
    blocks = [("stem", "conv_input"), ("stage1.0", "conv1.0"), ("out", "conv_out")]
    blocks += [(f"stage{s}.{i}", f"conv{s}.{i}") for s in (2, 3, 4) for i in range(3)]
    for ours, theirs in blocks:
        yield f"encoder.{ours}.conv", f"backbone_3d.{theirs}.0"
        yield f"encoder.{ours}.norm", f"backbone_3d.{theirs}.1"


def bev_names(depths: tuple[int, ...]) -> Names:
    """Name the BEV backbone's layers; a stage there is one flat list that starts with an explicit zero padding."""
    for stage, depth in enumerate(depths):
        for layer in range(depth + 1):
            yield f"backbone.stages.{stage}.{layer}.0", f"backbone_2d.blocks.{stage}.{3 * layer + 1}"
            yield f"backbone.stages.{stage}.{layer}.1", f"backbone_2d.blocks.{stage}.{3 * layer + 2}"
        yield f"backbone.ups.{stage}.0", f"backbone_2d.deblocks.{stage}.0"
        yield f"backbone.ups.{stage}.1", f"backbone_2d.deblocks.{stage}.1"


def head_names() -> Names:
    """Name the anchor head's layers."""
    yield "head.cls", "dense_head.conv_cls"
    yield "head.box", "dense_head.conv_box"
    yield "head.direction", "dense_head.conv_dir_cls"


DISTRIBUTED = "module."
"""What stands before every name where a model was saved in its wrapper for several GPUs."""
PASSED_OVER = ("global_step",)
"""Entries of a checkpoint that are no part of the network."""


# --- configurations ---------------------------------------------------------------------------------------------------


def pointpillars_config(classes: int) -> PointPillarsConfig | None:
    """Return the toolbox's configuration for so many classes, with its empty slots."""
    kitti = PointPillarsConfig(empty_slots=True)
    once = VoxelGrid((-75.2, -75.2, -5.0), (75.2, 75.2, 3.0), (0.2, 0.2, 8.0))
    return {
        1: replace(kitti, anchors=kitti.anchors[:1]),
        3: kitti,
        5: replace(kitti, anchors=ONCE_ANCHORS, grid=once, max_points=20, max_voxels=60000),
    }.get(classes)


def second_config(classes: int) -> SECONDConfig | None:
    """Return the toolbox's configuration for so many classes."""
    return {1: KITTI_CAR, 3: SECONDConfig(), 5: SECOND_ONCE}.get(classes)


def voxel_rcnn_config(classes: int) -> VoxelRCNNConfig | None:
    """Return the toolbox's configuration for cars, and ours for more classes."""
    return {1: VoxelRCNNConfig(), 3: VOXEL_RCNN_KITTI, 5: VOXEL_RCNN_ONCE}.get(classes)


@dataclass(frozen=True)
class _Model:
    config: Callable[[int], DetectorConfig | None]
    build: Callable[[Any], AnyModel]
    names: Callable[[Any], Names]


MODELS = {
    "pointpillars": _Model(pointpillars_config, pointpillars, pointpillars_names),
    "second": _Model(second_config, second, second_names),
    "voxel_rcnn": _Model(voxel_rcnn_config, voxel_rcnn, voxel_rcnn_names),
}
"""Detectors that can be filled from a checkpoint."""


# --- reading ----------------------------------------------------------------------------------------------------------


def import_checkpoint(path: str | Path, model: str) -> AnyModel:
    """Build a detector and fill it from a checkpoint of OpenPCDet.

    Args:
        path: a ``.pth`` file with a ``model_state``.
        model: one of :data:`MODELS`.

    Returns:
        The detector in evaluation mode, float32, on the CPU.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: if it cannot be read, or if a tensor is missing, unknown or of another shape.
    """
    if model not in MODELS:
        raise BeamboxError(f'cannot import a model called "{model}"{did_you_mean(model, MODELS)}')
    state = read_checkpoint(path)
    kind = MODELS[model]
    config = kind.config(_count_classes(state, path))
    if config is None:
        raise BeamboxError(
            f"{path} has a head for {_count_classes(state, path)} classes; known are 1 (KITTI cars), 3 (KITTI) and "
            "5 (ONCE)"
        )
    detector = kind.build(config)
    _fill(detector, state, dict(kind.names(config)), f"{path} does not fit {model} with {len(config.classes)} classes")
    module_of(detector).eval()
    return detector


def read_checkpoint(path: str | Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint; pickled code in it is refused, not run.

    Raises:
        MissingFileError: if there is no such file.
        BeamboxError: if it is no checkpoint with a ``model_state`` of tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"no checkpoint {path}; give a .pth file that OpenPCDet wrote")
    try:
        with torch.serialization.safe_globals(_numpy_numbers()):
            stored = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError, KeyError, TypeError, AttributeError,
            IndexError, AssertionError, OverflowError, MemoryError, RecursionError, struct.error) as error:  # fmt: skip
        raise BeamboxError(f"cannot read {path}: {_refusal(error)}") from None
    state = stored.get("model_state") if isinstance(stored, dict) else None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        kind = f"the entries {sorted(map(str, stored))[:5]}" if isinstance(stored, dict) else type(stored).__name__
        raise BeamboxError(f'{path} must hold a dict "model_state" of tensors, as OpenPCDet writes it; got {kind}')
    if state and all(str(name).startswith(DISTRIBUTED) for name in state):
        state = {name.removeprefix(DISTRIBUTED): value for name, value in state.items()}
    return {name: value for name, value in state.items() if name not in PASSED_OVER}


def _numpy_numbers() -> list[Any]:
    """List what a pickle calls to make NumPy's numbers, by the names of NumPy 1 and 2; none of it runs other code.

    Training with OpenPCDet puts such numbers into the state of the optimizer (learning rates are made by ``np.cos``).
    """
    scalar = np.float64(0).__reduce__()[0]
    kinds = {type(np.dtype(code)) for code in "?bBhHiIlLqQefd"}
    return [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype, *kinds]


def _refusal(error: Exception) -> str:
    """Say what is wrong with a checkpoint; torch's own words advise to run the code in it."""
    text = str(error)
    code = re.search(r"GLOBAL (\S+)|(?:class|function) ([\w.]+)", text)
    if isinstance(error, pickle.UnpicklingError) and "weights" in text.lower() and code:
        return (
            f"it holds `{printable((code[1] or code[2])[:100])}`, a Python object that only running code from the file "
            'would restore; keep the tensors alone, where it was trained: torch.save({"model_state": '
            'checkpoint["model_state"]}, "tensors.pth")'
        )
    return "it is no whole checkpoint of PyTorch; expected a .pth file as OpenPCDet's training writes it"


def _count_classes(state: Mapping[str, Tensor], path: str | Path) -> int:
    """Tell the number of classes K from the 2 K anchors with K logits each."""
    head = state.get("dense_head.conv_cls.weight")
    if head is None:
        raise BeamboxError(f"{path} has no dense_head.conv_cls.weight: it is not an anchor-based detector of OpenPCDet")
    return round((len(head) / 2) ** 0.5)


def _fill(detector: AnyModel, state: Mapping[str, Tensor], layers: Mapping[str, str], refusal: str) -> None:
    """Copy every tensor; refuse before the first copy if any does not fit."""
    own = detector.state_dict()
    found: dict[str, Tensor] = {}
    wrong: list[str] = []
    used = set()
    for name, value in own.items():
        layer, _, leaf = name.rpartition(".")
        theirs = f"{layers[layer]}.{leaf}"
        used.add(theirs)
        if theirs not in state:
            wrong.append(f"{theirs} is missing")
            continue
        converted = _laid_out(state[theirs], value.shape)
        if converted is None:
            wrong.append(f"{theirs} has shape {tuple(state[theirs].shape)}, which does not make {tuple(value.shape)}")
            continue
        found[name] = converted.to(value.dtype)
    wrong += [f"{name} {tuple(state[name].shape)} is unknown" for name in state if name not in used]
    if wrong:
        more = f" and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise BeamboxError(f"{refusal}: {'; '.join(wrong[:5])}{more}")
    module_of(detector).load_state_dict(found)


def _laid_out(tensor: Tensor, shape: torch.Size) -> Tensor | None:
    """Bring a tensor into the layout of a parameter here, or return None where it does not fit.

    Sparse kernels there are (C_out, kz, ky, kx, C_in) since spconv 2 and
    (kz, ky, kx, C_in, C_out) before; here they are (K, C_in, C_out)
    1 x 1 convolutions over points stand here as linear layers.
    """
    if tensor.shape == shape:
        return tensor
    if tensor.dim() == 5:
        for kernel in (tensor.permute(1, 2, 3, 4, 0), tensor):
            if kernel.flatten(0, 2).shape == shape:
                return kernel.flatten(0, 2)
    if len(shape) == 2 and tensor.dim() > 2 and tensor.shape[:2] == shape and tensor.numel() == shape.numel():
        return tensor.reshape(shape)
    return None
